# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Whether this computer is fit to carry the arms of a parameter file: findings, each with the command that fixes it.

What only delays threads (the kernel, the governor, ...) is judged by its effect: where the measured wake-ups are in
time it is a note. What the computer does not state, as in a container, is unknown, and no fault.
"""

import json
import os
import resource
import socket
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from enum import IntEnum
from importlib import import_module, metadata
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from can.interfaces import BACKENDS
from rich.console import Console
from rich.progress import track

from exo_gravity.core.errors import BusError, named
from exo_gravity.core.motors.joint_motor import REPLY_SHARE, SIMULATED_BUSES, Traffic, motors_of, traffic_of
from exo_gravity.core.safety.limits import CAN_BRIDGE, limits_of
from exo_gravity.hardware.bus_lock import borrowed
from exo_gravity.hardware.can_port import ArmOnBus, serials_of
from exo_gravity.hardware.clock import raise_priority, set_realtime_priority
from exo_gravity.hardware.network import MIDDLEWARE, check_environment, open_to_others, restrict_to_localhost
from exo_gravity.lab.inputs.arms import node_values
from exo_gravity.lab.inputs.node_checks import check_nodes
from exo_gravity.lab.inputs.parameter_file import Nodes, can_options, stages
from exo_gravity.lab.packages import MissingPackageError, check_packages


class Level(IntEnum):
    """How bad a finding is."""

    FINE = 0
    UNKNOWN = 1  #: the computer does not state it, or it could not be tried
    NOTE = 2  #: could be better, without an effect that was seen
    WARNING = 3
    FAULT = 4  #: no one may wear an arm that this computer controls


STYLES = {Level.FINE: "green", Level.UNKNOWN: "dim", Level.NOTE: "", Level.WARNING: "yellow", Level.FAULT: "bold red"}


class Finding(NamedTuple):
    """One row. remedy: the command that fixes it, '' for none."""

    what: str
    found: str
    wanted: str
    level: Level = Level.FINE
    remedy: str = ""


def judged(what: str, found: str, wanted: str, is_fine: bool, otherwise: Level, remedy: str) -> Finding:
    """Return a finding: FINE or `otherwise`; UNKNOWN where nothing was found."""
    if not found:
        return Finding(what, "not stated", wanted, Level.UNKNOWN)
    return Finding(what, found, wanted) if is_fine else Finding(what, found, wanted, otherwise, remedy)


LATE = 0.001  # share of cycles that may be late by half a period, as in docs/performance.md
SLOW_WAKE = 0.1  # of a period, for which a CPU may wake from its deepest idle state
SLOW_CLOCKS = ("hpet", "acpi_pm", "jiffies", "refined-jiffies", "pit")  # a look at these takes microseconds
CPUS, CLOCKS = "sys/devices/system/cpu", "sys/devices/system/clocksource/clocksource0"
GROUP = "239.255.0.1"  # of the multicast datagram
IFF_UP = 1
LIMITS = "sudo tee -a /etc/security/limits.d/exo_gravity.conf; then log in again"
LONGEST_QUEUE = 2  # times the frames until a silent motor is noticed: a longer queue lets commands grow old unseen
UP = "sudo ip link set {0} down; sudo ip link set {0} up type can bitrate {1} restart-ms 100"
REMEDIES = {  # the command for each finding about the computer
    "kernel": "Ubuntu: sudo pro enable realtime-kernel; Debian: sudo apt install linux-image-rt-amd64",
    "CPU governor": f"echo performance | sudo tee /{CPUS}/cpu*/cpufreq/scaling_governor",
    "idle states": "echo 1 | sudo tee {deep}",
    "clock source": f"echo tsc | sudo tee /{CLOCKS}/current_clocksource",
    "nice value": f"echo '*  -  nice  -20' | {LIMITS}",
    "CPUs for the nodes": "start the launcher without taskset, or in a container with more CPUs",
    "real-time limits": rf"printf '* - rtprio 99\n* - memlock unlimited\n' | {LIMITS}",
}


class Wakeups(NamedTuple):
    """Wake-ups of a thread like the control loop's."""

    lateness: np.ndarray  #: s after each cycle was due
    nice: int  #: the nice value that it got
    refused: tuple[str, ...] = ()  #: a sentence for each real-time setting that was asked for and is not permitted


def _text(path: Path) -> str:
    """Return the content of a file, '' if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8").strip()
    except OSError:
        return ""


def measured(period: float, seconds: float, priority: int) -> Wakeups:
    """Run `measure` in a separate process, show its progress, and return its result."""
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
    refused: list[str] = []
    raise_priority(20)

    def run() -> None:
        deadline = time.monotonic()
        for cycle in range(len(lateness)):
            deadline += period
            time.sleep(max(0.0, deadline - time.monotonic()))
            lateness[cycle] = time.monotonic() - deadline

    thread = threading.Thread(target=run)
    thread.start()
    set_realtime_priority(priority, refused.append)
    thread.join()
    return Wakeups(lateness, os.getpriority(os.PRIO_PROCESS, 0), tuple(refused))


def of_wakeups(wakeups: Wakeups, period: float, timeout: float) -> Finding:
    """Judge the wake-ups of a loop with `period` (s), whose arm is let down after `timeout` (s) without efforts."""
    late, worst = float(np.mean(wakeups.lateness >= period / 2.0)), float(np.max(wakeups.lateness))
    p99 = float(np.percentile(wakeups.lateness, 99))
    return judged(
        f"wake-ups at {1.0 / period:g} Hz",
        f"p99 {1e3 * p99:.3g} ms, worst {1e3 * worst:.3g} ms, {late:.2%} late",
        f"{LATE:.1%} late by half a period, none by {500.0 * timeout:.0f} ms",
        late <= LATE and worst < timeout / 2.0,
        Level.FAULT if worst >= timeout else Level.WARNING,
        "see the notes and warnings below; end other programs, or lower `rate`",
    )


def of_computer(root: Path, wakeups: Wakeups, period: float, is_late: bool, priority: int) -> list[Finding]:
    """Judge what may delay a loop with `period` (s) and `thread_priority`; is_late: whether wake-ups were late.

    root: the folder that has /proc and /sys.
    """
    delays = Level.WARNING if is_late else Level.NOTE
    cpus = root / CPUS
    version, clock = _text(root / "proc/version"), _text(root / CLOCKS / "current_clocksource")
    real_time = _text(root / "sys/kernel/realtime") == "1" or "PREEMPT_RT" in version
    release = " ".join(version.split()[2:3])
    governors = {_text(path) for path in cpus.glob("cpu[0-9]*/cpufreq/scaling_governor")}
    permitted = [path for path in sorted(cpus.glob("cpu0/cpuidle/state*")) if _text(path / "disable") != "1"]
    waking = {path.name: 1e-6 * float(_text(path / "latency") or 0) for path in permitted}  # s
    deep = [f"/{CPUS}/cpu*/cpuidle/{state}/disable" for state, late in waking.items() if late > SLOW_WAKE * period]
    idle = f"a CPU wakes up within {1e6 * max(waking.values()):.0f} µs" if waking else ""
    cores = len(os.sched_getaffinity(0))
    soft = (resource.getrlimit(which)[0] for which in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK))
    rtprio, memlock = ("unlimited" if limit == resource.RLIM_INFINITY else f"{limit}" for limit in soft)
    required = f"as thread_priority {priority} requires" if priority else "none, thread_priority is 0"
    rows = [
        ("kernel", version and f"{release}, {'' if real_time else 'not '}PREEMPT_RT", "PREEMPT_RT", real_time, delays),
        ("CPU governor", ", ".join(sorted(governors)), "performance", governors == {"performance"}, delays),
        ("idle states", idle, f"{1e6 * SLOW_WAKE * period:.0f} µs", not deep, delays),
        ("clock source", clock, "tsc, or a virtual machine's", clock not in SLOW_CLOCKS, delays),
        ("nice value", f"{wakeups.nice}", "-20", wakeups.nice == -20, delays),
        ("CPUs for the nodes", f"{cores}", "2", cores > 1, Level.WARNING),
        ("real-time limits", f"rtprio {rtprio}, memlock {memlock}", required, not wakeups.refused, Level.WARNING),
    ]
    return [judged(*row, REMEDIES[row[0]].format(deep=" ".join(deep))) for row in rows]


def of_middleware(middleware: str, reach: str, opening: str) -> Iterator[Finding]:
    """Judge ROS's settings. reach: the discovery range. opening: the setting that lets other hosts in, '' for none."""
    remedy = f"export RMW_IMPLEMENTATION={MIDDLEWARE}"
    yield judged("middleware", middleware, MIDDLEWARE, middleware == MIDDLEWARE, Level.WARNING, remedy)
    if reach == "OFF":
        remedy = "unset EXO_GRAVITY_DISCOVERY_RANGE"
        yield Finding("discovery", reach, "LOCALHOST: the nodes must find each other", Level.FAULT, remedy)
    else:
        wanted = "LOCALHOST or SROS2: no other host may command the arm"
        remedy = f"unset {opening.partition('=')[0]}; or enforce SROS2, docs/security.md"
        yield judged("discovery", opening or reach, wanted, not opening, Level.WARNING, remedy)


def of_multicast(is_needed: bool) -> Finding:
    """Send a multicast datagram to this computer, and judge whether it arrives. is_needed: by a simulated bus."""
    found = "arrives"
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
        found = f"{error.strerror or error}"
    wanted, remedy = "for udp_multicast" if is_needed else "not needed", "sudo ip route add 224.0.0.0/4 dev lo"
    return judged("multicast", found, wanted, found == "arrives" or not is_needed, Level.FAULT, remedy)


def of_load(name: str, traffic: Traffic, rate: float) -> Finding:
    """Judge the load of a bridge's bus at `rate` (Hz)."""
    share, most = traffic.load(rate), int(REPLY_SHARE * traffic.largest_rate)
    found = f"{share:.0%} at {rate:g} Hz, {traffic.load(rate, worst=True):.0%} at worst"
    level = Level.FAULT if share > 1.0 else Level.WARNING
    fine, remedy = share <= 1.0 and not traffic.is_crowded(rate), f"set `rate` to {most} in the file"
    return judged(f"{name}: bus load", found, f"{REPLY_SHARE:.0%}, 100% at worst", fine, level, remedy)


def of_interface(name: str, root: Path, bitrate: int, frames: int) -> Iterator[Finding]:
    """Judge a SocketCAN interface by /sys below `root` and by what `ip` reports.

    bitrate: bit/s that the parameter file states. frames: those sent until a silent motor is noticed: a shorter queue
    overflows before, and hides which motor it was.
    """
    folder = root / "sys/class/net" / name
    if not folder.exists():
        yield Finding(name, "no such interface", "a CAN interface", Level.FAULT, "plug the adapter in; ip link")
        return
    info = _link(name).get("linkinfo", {})
    data, is_virtual = info.get("info_data", {}), info.get("info_kind") == "vcan"
    is_up, state, wanted = int(_text(folder / "flags") or "0", 16) & IFF_UP, data.get("state", ""), "ERROR-ACTIVE"
    up = f"sudo ip link set {name} up" if is_virtual else UP.format(name, bitrate)
    if not is_up or state in ("BUS-OFF", "STOPPED"):
        yield Finding(f"{name}: state", state if is_up else "down", wanted, Level.FAULT, up)
        return
    if is_virtual:
        yield Finding(f"{name}: state", "up, virtual", "up")
        return
    remedy = f"check bit rate, termination and plugs, docs/wiring.md; then {up}"
    yield judged(f"{name}: state", state, wanted, state == wanted, Level.WARNING, remedy)
    queue, remedy = int(_text(folder / "tx_queue_len") or 0), f"sudo ip link set {name} txqueuelen {frames}"
    fits = frames <= queue <= LONGEST_QUEUE * frames
    yield judged(
        f"{name}: txqueuelen", f"{queue}", f"{frames} to {LONGEST_QUEUE * frames}", fits, Level.WARNING, remedy
    )
    actual, restart = data.get("bittiming", {}).get("bitrate"), data.get("restart_ms", 0)
    found, wanted = f"{actual} bit/s" if actual else "", f"{bitrate} bit/s"
    yield judged(f"{name}: bit rate", found, wanted, actual == bitrate, Level.FAULT, up)
    found = f"after {restart} ms" if restart else "never"
    yield judged(f"{name}: restart", found if data else "", "after 100 ms", restart > 0, Level.WARNING, up)


def _link(name: str) -> Mapping[str, Any]:
    """Return what `ip` reports about an interface, {} if it reports nothing."""
    try:
        command = ["ip", "-json", "-details", "link", "show", name]
        links = json.loads(subprocess.run(command, capture_output=True, check=True, timeout=5.0).stdout)
    except (OSError, ValueError, subprocess.SubprocessError):
        return {}
    return dict(links[0]) if links else {}


def of_nodes(nodes: Nodes, bridges: Mapping[str, Mapping[str, Any]]) -> Iterator[Finding]:
    """Judge each node that waits for /clock, which `bridges` with a real bus refuse, or lacks a Python package."""
    for node, given in nodes.items():
        try:
            check_packages((node.rpartition("/")[2],))
        except MissingPackageError as error:
            yield Finding(f"{node}: packages", "missing", "installed", Level.WARNING, str(error))
        if given.get("use_sim_time") is True:
            is_real = node in bridges and bridges[node]["can.interface"] not in SIMULATED_BUSES
            level, wanted = Level.FAULT if is_real else Level.WARNING, "false, or a program that publishes /clock"
            yield Finding(f"{node}: use_sim_time", "true", wanted, level, "remove use_sim_time from the file")


def of_port(port: str, root: Path) -> Finding:
    """Judge a serial port, whose USB adapter may keep bytes for some time."""
    device = (root / port.partition("@")[0].lstrip("/")).resolve()
    if not device.exists():
        return Finding(port, "no such port", "a serial port", Level.FAULT, "plug it in; ls /dev/serial/by-id")
    timer = f"sys/bus/usb-serial/devices/{device.name}/latency_timer"
    latency = _text(root / timer)
    found, fine = f"{latency} ms" if latency else "none", latency in ("", "1")
    return judged(f"{port}: latency", found, "1 ms", fine, Level.WARNING, f"echo 1 | sudo tee /{timer}")


def of_buses(nodes: Nodes, bridges: Mapping[str, Mapping[str, Any]], root: Path) -> Iterator[Finding]:
    """Judge the bus of each bridge, and each serial port. Raises ParameterError where a bridge would refuse its values.

    bridges: the parameter values of each by its full name.
    """
    for node, values in bridges.items():
        with named(f"{node} "):
            rate, limits, buses = values["rate"], limits_of(values), traffic_of(values, can_options(nodes[node]))
            serials = serials_of(values["can.serial"], values["can.channel"], len(values["joint_names"]))
            address = values["can.interface"], values["can.channel"], can_options(nodes[node])
            arm = ArmOnBus(address, motors_of(values), limits, 1.0 / rate, serials=serials)
        yield from (of_opening(node, part) for part in arm.parts)
        for channel, bus in buses.items():
            yield of_load(f"{node} {channel}", bus, rate)
            if values["can.interface"] == "socketcan":
                frames = round((bus.replying + bus.reporting) * limits.reply_timeout * rate)
                yield from of_interface(channel, root, bus.bitrate, frames)
    ports = (str(given.get("can.channel", "")) for given in nodes.values())
    for port in sorted({port.strip() for names in ports for port in names.split(",")}):
        if port.startswith("/dev/"):
            yield of_port(port, root)


def examine(nodes: Nodes, seconds: float, root: Path) -> list[Finding]:
    """Return every finding; seconds: for which wake-ups are measured. Raises ParameterError."""
    check_environment()
    check_nodes(nodes)
    bridges = {node: node_values(nodes, node, CAN_BRIDGE) for node in stages(nodes)[0]}
    buses = list(of_buses(nodes, bridges, root))
    settings = list(bridges.values()) or [{param.name: param.default for param in CAN_BRIDGE}]
    period, priority = 1.0 / max(s["rate"] for s in settings), max(s["thread_priority"] for s in settings)
    timeout = min(s[name] for s in settings for name in ("command_timeout", "frozen_timeout"))
    wakeups = measured(period, seconds, priority)
    late = of_wakeups(wakeups, period, timeout)
    restrict_to_localhost()
    middleware, reach = os.environ.get("RMW_IMPLEMENTATION"), os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"]
    return [
        late,
        *of_computer(root, wakeups, period, late.level > Level.FINE, priority),
        *of_middleware(middleware or MIDDLEWARE, reach, open_to_others()),
        of_multicast(any(s["can.interface"] == "udp_multicast" for s in settings)),
        *of_nodes(nodes, bridges),
        *buses,
    ]


def of_opening(name: str, bus: ArmOnBus) -> Finding:
    """Import python-can's backend of a bus, and open the bus for a moment, without a frame, unless a bridge holds it.

    name: of the bridge. bus: the part of its arm on this bus.
    """
    interface, channel, _ = bus.address
    what, wanted = f"{name} {channel}: opens", f"yes, with {interface}"
    if interface not in BACKENDS:
        others = f"can.interface: one of {', '.join(sorted(BACKENDS))}"
        return Finding(what, f"python-can has no interface {interface}", wanted, Level.FAULT, others)
    try:
        import_module(BACKENDS[interface][0])
    except Exception as error:  # drivers of makers raise errors of every type
        return Finding(what, f"no driver: {_one_line(error)}", wanted, Level.FAULT, _driver(interface))
    with borrowed(bus.address) as holder:
        if holder:
            return Finding(what, f"not tried: held by {holder}", wanted, Level.UNKNOWN)
        try:
            bus.open(bus.address).shutdown()
        except BusError as error:
            reason = _one_line(error.__cause__ or error)
            return Finding(what, reason, wanted, Level.FAULT, f"plug the adapter in; {_driver(interface)}")
    return Finding(what, "yes", wanted)


def _one_line(error: BaseException) -> str:
    return " ".join(f"{error}".split()) or type(error).__name__


def _driver(interface: str) -> str:
    """Return what installs the driver of a python-can interface, as python-can's own metadata names it."""
    extras = {extra.replace("-", "_") for extra in metadata.metadata("python-can").get_all("Provides-Extra") or ()}
    if interface in extras:
        return f"pip install 'python-can[{interface}]'"
    return f"install the driver of {interface}: https://python-can.readthedocs.io/en/stable/interfaces.html"


def show(findings: Sequence[Finding], console: Console) -> None:
    """Print each finding, and below it the command that fixes it, unwrapped."""
    heading = Finding("what", "found", "wanted")
    rows = (heading, *findings)
    what, found = max(len(row.what) for row in rows), max(len(row.found) for row in rows)
    for row in rows:
        level, style = ("", "bold") if row is heading else (row.level.name.lower(), STYLES[row.level])
        line = f"{level:<7}  {row.what:<{what}}  {row.found:<{found}}  {row.wanted}"
        console.print(line, style=style, markup=False, soft_wrap=True)
        if row.remedy:
            console.print(f"{'':<7}  -> {row.remedy}", markup=False, highlight=False, soft_wrap=True)
