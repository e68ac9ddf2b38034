# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
