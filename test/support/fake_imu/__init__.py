"""Models of IMUs that speak their real protocol: registers on an I2C bus, packets on a pseudo-terminal.

Written from the data sheets and independent of the drivers: they share no constant.
"""
