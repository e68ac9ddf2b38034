# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the wearer of an arm does: their torque, share of the arm, contacts, and how much support they need."""
