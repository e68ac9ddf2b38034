"""The AK60-6 and AK80-9 motors: their limits, their frames, and the load of these on the bus."""
