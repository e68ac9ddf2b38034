"""Every test run has a ROS domain and a multicast port of its own, and speaks to this machine alone."""

import os

DOMAIN = os.getpid() % 100 + 1
PORT = 20_000 + os.getpid() % 10_000

os.environ["ROS_DOMAIN_ID"] = str(DOMAIN)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
