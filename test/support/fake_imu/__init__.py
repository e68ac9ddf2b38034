# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""IMUs that speak their real protocol: registers on an I2C bus, packets on a pseudo-terminal."""
