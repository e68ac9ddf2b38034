"""The trunk's tilt from its IMU."""
