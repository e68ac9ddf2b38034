"""IMUs that speak their real protocol: registers on an I2C bus, packets on a pseudo-terminal."""
