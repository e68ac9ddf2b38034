# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""From joint angles and tilt to the efforts that hold the arm."""
