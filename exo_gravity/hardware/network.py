# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What ROS 2 reads from the environment: which computers it communicates with, and what would end every node."""

import os
from pathlib import Path

from exo_gravity.core.errors import ParameterError

RANGE, ROS_RANGE = "EXO_GRAVITY_DISCOVERY_RANGE", "ROS_AUTOMATIC_DISCOVERY_RANGE"
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
HIGHEST_DOMAIN = 232  # beyond, DDS has no ports
MIDDLEWARE = "rmw_fastrtps_cpp"  # under which the nodes were tried


def check_environment() -> None:
    """Check the environment for what ends every node at its start. Raises ParameterError that names the variable."""
    get = os.environ.get
    domain = get("ROS_DOMAIN_ID") or "0"
    if not (domain.isdecimal() and int(domain) <= HIGHEST_DOMAIN):
        expected = f"a whole number from 0 to {HIGHEST_DOMAIN}, the same in every terminal"
        raise ParameterError("ROS_DOMAIN_ID", domain, expected)
    middleware = get("RMW_IMPLEMENTATION") or MIDDLEWARE
    libraries = (Path(prefix, "lib", f"lib{middleware}.so") for prefix in get("AMENT_PREFIX_PATH", "").split(":"))
    if middleware != MIDDLEWARE and not any(library.exists() for library in libraries):
        raise ParameterError("RMW_IMPLEMENTATION", middleware, f"installed; unset it for {MIDDLEWARE}")
    log = Path(get("ROS_LOG_DIR") or Path(get("ROS_HOME") or "~/.ros", "log")).expanduser()
    try:
        log.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        expected = f"a folder that can be made ({error.strerror}): export ROS_LOG_DIR=/tmp/ros_log"
        raise ParameterError("ROS's folder of logs", str(log), expected) from None


def restrict_to_localhost() -> None:
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


def localhost_notice() -> str:
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
