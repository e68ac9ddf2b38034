# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Calibration without I/O: what poses tell of an arm (identification.py), and the tour that visits them (tour.py)."""
