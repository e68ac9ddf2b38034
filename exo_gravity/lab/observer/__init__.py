"""What the wearer does: the torque that neither the arm's model nor the motors account for."""
