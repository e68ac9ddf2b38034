"""How well the arm tells what its wearer does: the study of `wearer_efforts` (docs/wearer_torque.md)."""
