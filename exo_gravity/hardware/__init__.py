"""Devices: the CAN bus of the motors, the IMU. Drivers raise, nodes decide."""
