# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The arm as a model: links, gravity, the wearer, the trunk's tilt, the torque budget."""
