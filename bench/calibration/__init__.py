# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The study of `calibrate`: random simulated devices, calibrated from a box of motors to an arm that holds."""
