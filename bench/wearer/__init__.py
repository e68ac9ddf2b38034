# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""How well the arm estimates what its wearer does: the study of `wearer_efforts` (docs/wearer_torque.md)."""
