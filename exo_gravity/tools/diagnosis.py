"""What the state of a computer means for an arm that it carries: values in, findings out.

What only delays threads (the kernel, the governor, ...) is judged by its effect: where the measured wake-ups are in
time it is a note. What the computer does not state, as in a container, is unknown, and no fault.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from exo_gravity.core.motors.joint_motor import REPLY_SHARE, Traffic

LATE = 0.001  # share of cycles that may be late by half a period, as in docs/performance.md
SLOW_WAKE = 0.1  # of a period, for which a CPU may wake from its deepest idle state
MIDDLEWARE = "rmw_fastrtps_cpp"  # the one that the package was tried with, and Jazzy's default
SLOW_CLOCKS = ("hpet", "acpi_pm", "jiffies", "refined-jiffies", "pit")  # a look at these takes microseconds
CPU = "/sys/devices/system/cpu/cpu*"
CLOCKS = "/sys/devices/system/clocksource/clocksource0"
LIMITS = "sudo tee -a /etc/security/limits.d/exo_gravity.conf; then log in again"
UP = "sudo ip link set {0} down; sudo ip link set {0} up type can bitrate {1} restart-ms 100"


class Level(IntEnum):
    """How bad a finding is."""

    FINE = 0
    UNKNOWN = 1  #: the computer does not state it
    NOTE = 2  #: could be better, without an effect that was seen
    WARNING = 3
    FAULT = 4  #: no one may wear an arm that this computer controls


@dataclass(frozen=True)
class Finding:
    """One row. mend: the command that mends it, '' for none."""

    what: str
    found: str
    wanted: str
    level: Level = Level.FINE
    mend: str = ""


@dataclass(frozen=True)
class Wakeups:
    """Wake-ups of a thread like the control loop's."""

    lateness: np.ndarray  #: s after each cycle was due
    nice: int  #: the nice value that it got
    refused: tuple[str, ...] = ()  #: a sentence for each real-time setting that was asked for and is not permitted


@dataclass(frozen=True)
class Computer:
    """What a computer states of itself; '' or empty where it states nothing."""

    kernel: str  #: /proc/version
    real_time: str  #: /sys/kernel/realtime
    governors: str  #: of all CPUs
    idle_states: Mapping[str, float]  #: s to wake up from each that is permitted
    cores: int  #: on which processes may run
    isolated: str
    clock_source: str
    limits: str  #: rtprio and memlock, for display


def judged(what: str, found: str, wanted: str, is_fine: bool, otherwise: Level, mend: str) -> Finding:
    """Return a finding: FINE or `otherwise`; UNKNOWN where nothing was found."""
    if not found:
        return Finding(what, "not stated", wanted, Level.UNKNOWN)
    return Finding(what, found, wanted) if is_fine else Finding(what, found, wanted, otherwise, mend)


def of_wakeups(wakeups: Wakeups, period: float, timeout: float) -> Finding:
    """Judge the wake-ups of a loop with `period` (s), whose arm is let down after `timeout` (s) without efforts."""
    late, worst = float(np.mean(wakeups.lateness >= period / 2.0)), float(np.max(wakeups.lateness))
    p99 = float(np.percentile(wakeups.lateness, 99))
    level = Level.FINE if late <= LATE and worst < timeout / 2.0 else Level.WARNING
    return Finding(
        f"wake-ups at {1.0 / period:g} Hz",
        f"p99 {1e3 * p99:.3g} ms, worst {1e3 * worst:.3g} ms, {late:.2%} late",
        f"{LATE:.1%} late by half a period, none by {500.0 * timeout:.0f} ms",
        Level.FAULT if worst >= timeout else level,
        "see the notes and warnings below; end other programs, or lower `rate`" if level else "",
    )


def of_computer(computer: Computer, wakeups: Wakeups, period: float, is_late: bool, priority: int) -> Iterator[Finding]:
    """Judge what may delay a loop with `period` (s) and `thread_priority`; is_late: whether wake-ups were late."""
    delays = Level.WARNING if is_late else Level.NOTE
    real_time = computer.real_time == "1" or "PREEMPT_RT" in computer.kernel
    kernel = " ".join(computer.kernel.split()[2:3]) + (", PREEMPT_RT" if real_time else ", not PREEMPT_RT")
    mend = "Ubuntu: sudo pro enable realtime-kernel; Debian: sudo apt install linux-image-rt-amd64"
    yield judged("kernel", computer.kernel and kernel, "PREEMPT_RT", real_time, delays, mend)
    governors, mend = computer.governors, f"echo performance | sudo tee {CPU}/cpufreq/scaling_governor"
    yield judged("CPU governor", governors, "performance", governors == "performance", delays, mend)
    deep = [state for state, latency in computer.idle_states.items() if latency > SLOW_WAKE * period]
    slowest = max(computer.idle_states.values(), default=0.0)
    found = f"a CPU wakes up within {1e6 * slowest:.0f} µs" if computer.idle_states else ""
    mend = f"echo 1 | sudo tee {' '.join(f'{CPU}/cpuidle/{state}/disable' for state in deep)}"
    yield judged("idle states", found, f"{1e6 * SLOW_WAKE * period:.0f} µs", not deep, delays, mend)
    source, mend = computer.clock_source, f"echo tsc | sudo tee {CLOCKS}/current_clocksource"
    yield judged("clock source", source, "tsc, or a virtual machine's", source not in SLOW_CLOCKS, delays, mend)
    mend = f"echo '*  -  nice  -20' | {LIMITS}"
    yield judged("nice value", f"{wakeups.nice}", "-20", wakeups.nice == -20, delays, mend)
    cores, mend = f"{computer.cores}", "start the launcher without taskset, or in a container with more CPUs"
    yield judged("CPUs for the nodes", cores, "2", computer.cores > 1, Level.WARNING, mend)
    if computer.isolated:
        mend = "remove isolcpus= from the kernel's command line: the nodes run on the other CPUs"
        yield Finding("isolated CPUs", computer.isolated, "none", Level.NOTE, mend)
    if not priority:
        yield Finding("real-time limits", computer.limits, "none, thread_priority is 0")
        return
    mend = rf"printf '* - rtprio 99\n* - memlock unlimited\n' | {LIMITS}"
    wanted = f"as thread_priority {priority} requires"
    yield judged("real-time limits", computer.limits, wanted, not wakeups.refused, Level.WARNING, mend)


def of_middleware(middleware: str, reach: str, opening: str) -> Iterator[Finding]:
    """Judge ROS's settings. reach: the discovery range. opening: the setting that lets other hosts in, '' for none."""
    mend = f"export RMW_IMPLEMENTATION={MIDDLEWARE}"
    yield judged("middleware", middleware, MIDDLEWARE, middleware == MIDDLEWARE, Level.WARNING, mend)
    if reach == "OFF":
        mend = "unset EXO_GRAVITY_DISCOVERY_RANGE"
        yield Finding("discovery", reach, "LOCALHOST: the nodes must find each other", Level.FAULT, mend)
    else:
        wanted = "LOCALHOST or SROS2: no other host may command the arm"
        mend = f"unset {opening.partition('=')[0]}; or enforce SROS2, docs/security.md"
        yield judged("discovery", opening or reach, wanted, not opening, Level.WARNING, mend)


def of_multicast(problem: str, is_needed: bool) -> Finding:
    """Judge multicast. problem: why a datagram does not come back, '' if it does. is_needed: by a simulated bus."""
    wanted, mend = "for udp_multicast" if is_needed else "not needed", "sudo ip route add 224.0.0.0/4 dev lo"
    return judged("multicast", problem or "arrives", wanted, not (problem and is_needed), Level.FAULT, mend)


def of_load(node: str, traffic: Traffic, rate: float) -> Finding:
    """Judge the load of a bridge's bus at `rate` (Hz)."""
    share, most = traffic.load(rate), int(REPLY_SHARE * traffic.largest_rate)
    level = Level.FAULT if share > 1.0 else Level.WARNING if traffic.is_crowded(rate) else Level.FINE
    found = f"{share:.0%} at {rate:g} Hz, {traffic.load(rate, worst=True):.0%} at worst"
    wanted = f"{REPLY_SHARE:.0%}, 100% at worst"
    return Finding(f"{node}: bus load", found, wanted, level, f"set `rate` to {most} in the file" if level else "")


def of_interface(
    name: str, is_up: bool | None, queue: int, link: Mapping[str, Any], bitrate: int, frames: int
) -> Iterator[Finding]:
    """Judge a SocketCAN interface. is_up: None if it does not exist. link: the output of `ip -json -details link show`.

    bitrate: bit/s that the parameter file states. frames: those sent until a silent motor is noticed: a shorter queue
    overflows before, and hides which motor it was.
    """
    is_virtual = link.get("linkinfo", {}).get("info_kind") == "vcan"
    up = f"sudo ip link set {name} up" if is_virtual else UP.format(name, bitrate)
    if is_up is None:
        yield Finding(name, "no such interface", "a CAN interface", Level.FAULT, "plug the adapter in; ip link")
        return
    data = link.get("linkinfo", {}).get("info_data", {})
    state, wanted = data.get("state", ""), "ERROR-ACTIVE"
    if not is_up or state in ("BUS-OFF", "STOPPED"):
        yield Finding(f"{name}: state", state if is_up else "down", wanted, Level.FAULT, up)
        return
    if is_virtual:
        yield Finding(f"{name}: state", "up, virtual", "up")
        return
    mend = f"check bit rate, termination and plugs, docs/wiring.md; then {up}"
    yield judged(f"{name}: state", state, wanted, state == wanted, Level.WARNING, mend)
    mend = f"sudo ip link set {name} txqueuelen 1000"
    yield judged(f"{name}: txqueuelen", f"{queue}", f"{frames}", queue >= frames, Level.WARNING, mend)
    actual, restart = data.get("bittiming", {}).get("bitrate"), data.get("restart_ms", 0)
    found, wanted = f"{actual} bit/s" if actual else "", f"{bitrate} bit/s"
    yield judged(f"{name}: bit rate", found, wanted, actual == bitrate, Level.FAULT, up)
    found = f"after {restart} ms" if restart else "never"
    yield judged(f"{name}: restart", found if data else "", "after 100 ms", restart > 0, Level.WARNING, up)


def of_port(port: str, exists: bool, latency: str, folder: str) -> Finding:
    """Judge a serial port. latency: ms for which its adapter may keep bytes, '' if it states none; folder: of it."""
    if not exists:
        return Finding(port, "no such port", "a serial port", Level.FAULT, "plug it in; ls /dev/serial/by-id")
    mend = f"echo 1 | sudo tee {folder}/latency_timer"
    fine = not latency or latency == "1"
    return judged(f"{port}: latency", f"{latency} ms" if latency else "none", "1 ms", fine, Level.WARNING, mend)
