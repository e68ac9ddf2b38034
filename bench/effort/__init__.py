# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""How hard the simulated arm is to move, under every setting of the compensator: `make study NAME=effort`."""
