# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the tools show: reports of trials, figures, pages and clips."""
