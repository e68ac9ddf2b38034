"""Calibration without I/O: what poses tell of an arm, and the tour that visits them.

tour.py moves and measures; identification.py solves for moments, scales and offsets; imu_mounting.py finds how the IMU
sits on the trunk.
"""
