# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What comes on top of gravity compensation: terms that are summed, and one shaper that limits their sum."""
