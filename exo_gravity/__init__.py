"""Feed-forward gravity compensation for a worn upper-body exoskeleton (ROS 2)."""
