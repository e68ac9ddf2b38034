"""IMUs that the `imu` node reads itself, one file each."""
