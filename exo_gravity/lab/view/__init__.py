"""What viewers show: the robot description and the shapes around it."""
