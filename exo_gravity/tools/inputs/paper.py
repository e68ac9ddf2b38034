"""Figures that the paper publishes, section "Results from Simulation": RMSE of joints 2 to 4 over 1,053 positions."""

PAPER_ANALYTICAL = (6.06e-16, 4.06e-16, 8.03e-17)  # Nm
PAPER_ANFIS = (1.71e-3, 1.32e-3, 3.15e-4)  # Nm
PAPER_SECONDS = 380.0  # s, training of one joint
