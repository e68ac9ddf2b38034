# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A trial: its script, what was recorded, the analysis and the verdict."""
