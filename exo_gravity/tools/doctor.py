"""doctor --params FILE: whether this computer is fit to carry the arms of a parameter file.

It reads the computer's settings, and measures for ten seconds how late a thread like the control loop's wakes up. Each
line has what it looked at, what it found and what is wanted; below it stands the command that mends it.

Exit code 0: fine. 1: warnings. 2: no one may wear an arm that this computer controls; also wrong use or wrong file.
"""

import argparse
import json
import os
import resource
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from exo_gravity.core.errors import ExoGravityError, named
from exo_gravity.core.motors.joint_motor import motors_of, traffic_of
from exo_gravity.core.safety.limits import CAN_BRIDGE, FROZEN, check_bridge, limits_of
from exo_gravity.hardware.clock import favour, request_real_time
from exo_gravity.tools import diagnosis
from exo_gravity.tools.cli import extras, non_negative, require_ros
from exo_gravity.tools.diagnosis import Computer, Finding, Level, Wakeups
from exo_gravity.tools.inputs.arms import can_options, node_values
from exo_gravity.tools.inputs.parameter_file import Nodes, check_buses, load, packaged_config, stages

if TYPE_CHECKING:
    from rich.console import Console

CPUS, NET, USB_SERIAL = "sys/devices/system/cpu", "sys/class/net", "sys/bus/usb-serial/devices"
GROUP = "239.255.0.1"
IFF_UP = 1
STYLES = {Level.FINE: "green", Level.UNKNOWN: "dim", Level.NOTE: "", Level.WARNING: "yellow", Level.FAULT: "bold red"}


def read_computer(root: Path) -> Computer:
    """Return what the computer states of itself in /proc and /sys below `root`."""
    cpus = root / CPUS
    governors = {_text(path) for path in cpus.glob("cpu[0-9]*/cpufreq/scaling_governor")}
    states = [path for path in sorted(cpus.glob("cpu0/cpuidle/state*")) if _text(path / "disable") != "1"]
    rtprio, memlock = (_limit(which) for which in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK))
    return Computer(
        _text(root / "proc/version"),
        _text(root / "sys/kernel/realtime"),
        ", ".join(sorted(governors)),
        {path.name: 1e-6 * float(_text(path / "latency") or 0) for path in states},
        len(os.sched_getaffinity(0)),
        _text(cpus / "isolated"),
        _text(root / "sys/devices/system/clocksource/clocksource0/current_clocksource"),
        f"rtprio {rtprio}, memlock {memlock}",
    )


def _text(path: Path) -> str:
    """Return the content of a file, '' if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8").strip()
    except OSError:
        return ""


def _limit(which: int) -> str:
    soft, _ = resource.getrlimit(which)
    return "unlimited" if soft == resource.RLIM_INFINITY else f"{soft}"


def measured(period: float, seconds: float, priority: int) -> Wakeups:
    """Run `measure` in a separate process, show its progress, and return its result."""
    from rich.progress import track

    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        wakeups = pool.submit(measure, period, seconds, priority)
        for _ in track(range(100), f"Wake-ups at {1.0 / period:g} Hz", transient=True):
            wait((wakeups,), seconds / 100.0)
        return wakeups.result()


def measure(period: float, seconds: float, priority: int) -> Wakeups:
    """Return how late a thread wakes up that is paced and favoured like the control loop of can_bridge.

    period: s. priority: `thread_priority`.
    """
    lateness = np.zeros(max(1, round(seconds / period)))
    nice: list[int] = []
    refused: list[str] = []
    started = threading.Event()

    def run() -> None:
        favour(20)
        nice.append(os.getpriority(os.PRIO_PROCESS, 0))
        started.set()
        deadline = time.monotonic()
        for cycle in range(len(lateness)):
            deadline += period
            time.sleep(max(0.0, deadline - time.monotonic()))
            lateness[cycle] = time.monotonic() - deadline

    thread = threading.Thread(target=run)
    thread.start()
    started.wait()
    request_real_time(priority, refused.append)
    thread.join()
    return Wakeups(lateness, nice[0], tuple(refused))


def multicast_problem() -> str:
    """Return why a multicast datagram does not come back to this computer, '' if it does."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.bind(("", 0))
            member = socket.inet_aton(GROUP) + socket.inet_aton("0.0.0.0")
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)  # not beyond this computer
            sock.settimeout(1.0)
            sock.sendto(b"doctor", (GROUP, sock.getsockname()[1]))
            sock.recv(16)
    except OSError as error:
        return f"{error.strerror or error}"
    return ""


def link_of(name: str) -> Mapping[str, Any]:
    """Return what `ip` reports about an interface, {} if it reports nothing."""
    try:
        command = ["ip", "-json", "-details", "link", "show", name]
        links = json.loads(subprocess.run(command, capture_output=True, check=True, timeout=5.0).stdout)
    except (OSError, ValueError, subprocess.SubprocessError):
        return {}
    return dict(links[0]) if links else {}


def of_buses(nodes: Nodes, bridges: Mapping[str, Mapping[str, Any]], root: Path) -> Iterator[Finding]:
    """Judge the bus of each bridge, and each serial port. Raises ParameterError where a bridge would refuse its values.

    bridges: the parameter values of each by its full name.
    """
    for node, values in bridges.items():
        with named(f"{node} "):
            rate, limits, buses = values["rate"], limits_of(values), traffic_of(values, can_options(nodes[node]))
            for bus in buses.values():
                check_bridge(rate, motors_of(values), limits, bus.status_rate)
        for channel, bus in buses.items():
            yield diagnosis.of_load(f"{node} {channel}", bus, rate)
            if values["can.interface"] == "socketcan":
                motors = bus.replying + bus.reporting
                folder, frames = root / NET / channel, round(motors * limits.reply_timeout * rate)
                is_up = bool(int(_text(folder / "flags") or "0", 16) & IFF_UP) if folder.exists() else None
                queue = int(_text(folder / "tx_queue_len") or 0)
                yield from diagnosis.of_interface(channel, is_up, queue, link_of(channel), bus.bitrate, frames)
    named_ports = (str(given.get(key, "")) for given in nodes.values() for key in ("can.channel", "serial.port"))
    ports = {port.strip() for names in named_ports for port in names.split(",")}
    for port in sorted(port for port in ports if port.startswith("/dev/")):
        device = (root / port.partition("@")[0].lstrip("/")).resolve()
        folder = Path(USB_SERIAL, device.name)
        yield diagnosis.of_port(port, device.exists(), _text(root / folder / "latency_timer"), f"/{folder}")


def examine(nodes: Nodes, seconds: float, root: Path) -> list[Finding]:
    """Return every finding; seconds: for which wake-ups are measured. Raises ParameterError."""
    from exo_gravity.nodes.ros.run import keep_to_this_machine, open_to_others

    check_buses(nodes)
    bridges = {node: node_values(nodes, node, CAN_BRIDGE) for node in stages(nodes)[0]}
    buses = list(of_buses(nodes, bridges, root))
    settings = list(bridges.values()) or [{param.name: param.default for param in CAN_BRIDGE}]
    period, priority = 1.0 / max(s["rate"] for s in settings), max(s["thread_priority"] for s in settings)
    timeout = min(FROZEN, *(s["command_timeout"] for s in settings))
    wakeups = measured(period, seconds, priority)
    keep_to_this_machine()
    middleware, reach = os.environ.get("RMW_IMPLEMENTATION"), os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"]
    is_simulated = any(s["can.interface"] == "udp_multicast" for s in settings)
    late = diagnosis.of_wakeups(wakeups, period, timeout)
    return [
        late,
        *diagnosis.of_computer(read_computer(root), wakeups, period, late.level > Level.FINE, priority),
        *diagnosis.of_middleware(middleware or diagnosis.MIDDLEWARE, reach, open_to_others()),
        diagnosis.of_multicast(multicast_problem(), is_simulated),
        *buses,
    ]


def show(findings: Sequence[Finding], console: "Console") -> None:
    """Print each finding, and below it the command that mends it, unwrapped."""
    heading = Finding("what", "found", "wanted")
    what, found = (max(len(getattr(row, name)) for row in (heading, *findings)) for name in ("what", "found"))
    for row in (heading, *findings):
        level = "" if row is heading else row.level.name.lower()
        line = f"{level:<7}  {row.what:<{what}}  {row.found:<{found}}  {row.wanted}"
        console.print(line, style="bold" if row is heading else STYLES[row.level], markup=False, soft_wrap=True)
        if row.mend:
            console.print(f"{'':<7}  -> {row.mend}", markup=False, highlight=False, soft_wrap=True)


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="doctor", description="Whether this computer is fit to carry an arm.")
    parser.add_argument("--params", metavar="FILE", help="ROS 2 parameter file (default: the packaged sim.yaml)")
    seconds = "for which wake-ups are measured (%(default)s)"
    parser.add_argument("--seconds", type=non_negative, default=10.0, metavar="S", help=seconds)
    return parser.parse_args(args)


def main(args: Sequence[str] | None = None, root: Path = Path("/")) -> int:
    """Run the command line; return the exit code. root: the folder that has /proc and /sys."""
    options = _arguments(args)
    require_ros("doctor")
    with extras("doctor", "report"):
        from rich.console import Console
    try:
        nodes = load(options.params or packaged_config("sim.yaml"))
        findings = examine(nodes, options.seconds, root)
    except ExoGravityError as error:
        print(f"doctor: {error}", file=sys.stderr)
        return 2
    show(findings, Console(highlight=False))
    warnings, faults = (sum(row.level is level for row in findings) for level in (Level.WARNING, Level.FAULT))
    if faults:
        print(f"No one may wear an arm that this computer controls. Faults: {faults}, warnings: {warnings}")
        return 2
    print(f"Warnings: {warnings}" if warnings else "Fine")
    return int(warnings > 0)
