# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Who owns a bus, and what happens to its arm when the owner dies."""
