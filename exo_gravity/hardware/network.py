# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Which computers ROS 2 communicates with: this one alone, unless a person chose otherwise."""

import os
from pathlib import Path

RANGE, ROS_RANGE = "EXO_GRAVITY_DISCOVERY_RANGE", "ROS_AUTOMATIC_DISCOVERY_RANGE"
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"


def keep_to_this_machine() -> None:
    """Set which hosts this process communicates with; call it before `rclpy.init`.

    This machine alone, unless EXO_GRAVITY_DISCOVERY_RANGE widens it. ROS's setup.bash exports
    ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET, with which every host on the subnet could publish torques to a worn robot.
    There is no way to know whether a person chose that, so it does not count.
    """
    reach = os.environ[ROS_RANGE] = os.environ.get(RANGE) or "LOCALHOST"
    if reach != "LOCALHOST":
        return
    loopback = str(Path(__file__).with_name("fastdds.xml"))
    profile = os.environ.setdefault(PROFILES, loopback)
    if os.environ.get("ROS_STATIC_PEERS") and profile == loopback:  # over which no peer could be reached
        os.environ[PROFILES] = str(Path(__file__).with_name("fastdds_peers.xml"))


def kept_to_this_machine() -> str:
    """Return, for the log, that other computers see no node, and what admits them; '' if they may."""
    if os.environ.get(ROS_RANGE) != "LOCALHOST" or os.environ.get("ROS_STATIC_PEERS"):
        return ""
    return f"other computers do not see these nodes, whatever {ROS_RANGE} says; {RANGE}=SUBNET admits them"


def open_to_others() -> str:
    """Return the setting that lets other hosts publish to our topics; '' if none does, or if SROS2 is enforced."""
    get = os.environ.get
    if get("ROS_SECURITY_ENABLE") == "true" and get("ROS_SECURITY_STRATEGY") == "Enforce":
        return ""
    if get("ROS_DISCOVERY_SERVER"):
        return f"ROS_DISCOVERY_SERVER={get('ROS_DISCOVERY_SERVER')}"
    reach = get(ROS_RANGE)
    if get("ROS_LOCALHOST_ONLY") == "1" or reach == "OFF":  # rcl then ignores the settings below
        return ""
    if get("ROS_STATIC_PEERS"):
        return f"ROS_STATIC_PEERS={get('ROS_STATIC_PEERS')}"
    return "" if reach == "LOCALHOST" else f"{RANGE}={reach}"
