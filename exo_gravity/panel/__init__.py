"""The operator's panel without ROS: who may use it, who holds control, its page and its web server."""
