"""The study of `calibrate`: random simulated devices, calibrated from a box of motors to an arm that holds."""
