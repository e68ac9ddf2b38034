"""What stands between the requested efforts and the motors of a worn arm."""
