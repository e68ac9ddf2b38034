"""What comes on top of gravity compensation: terms that are summed, and one shaper that limits their sum."""
