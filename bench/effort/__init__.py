"""How hard the simulated arm is to move, under every setting of the compensator: `make study NAME=effort`."""
