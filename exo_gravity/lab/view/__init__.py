# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What viewers show: the robot description and the shapes around it."""
