"""The mathematics of the trunk's IMU."""
