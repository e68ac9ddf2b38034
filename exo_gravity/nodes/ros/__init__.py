"""What the nodes share of ROS: parameters, topics, diagnostics, start and stop."""
