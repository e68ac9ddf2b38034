# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""doctor: from what a computer states of itself to findings, commands and an exit code."""

import json
import os
import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from can.interfaces import BACKENDS

from exo_gravity.core.motors.joint_motor import Traffic
from exo_gravity.hardware.bus_lock import BusLock
from exo_gravity.lab import computer as settings
from exo_gravity.lab.computer import Level, Wakeups
from exo_gravity.tools import doctor

from ..support.ports import own_ports

PORTS = own_ports()
IN_TIME = Wakeups(np.full(2500, 1e-4), -20)
CPU = "sys/devices/system/cpu"
LINK = {"linkinfo": {"info_kind": "can", "info_data": {
    "state": "ERROR-ACTIVE", "restart_ms": 100, "bittiming": {"bitrate": 1_000_000}}}}  # fmt: skip


def wakeups(late: int, by: float) -> Wakeups:
    return IN_TIME._replace(lateness=np.r_[np.full(2500 - late, 1e-4), np.full(late, by)])


def of_computer(root: Path, is_late: bool = False, woken: Wakeups = IN_TIME, priority: int = 0):
    return {row.what: row for row in settings.of_computer(root, woken, 0.004, is_late, priority)}


def tells(root: Path, link: object) -> None:
    (root / "bin/ip").write_text(f"#!/bin/sh\necho '{json.dumps([link])}'\n")


def of_interface(root: Path, bitrate: int = 1_000_000):
    rows = list(settings.of_interface("can1", root, bitrate, 50))
    return {row.what: row for row in rows if row.level}, max(row.level for row in rows)


@pytest.fixture
def computer(tmp_path, monkeypatch):
    """A folder that looks like / on a computer where all is well, with `can0` and `can1`; `ip` tells of both."""
    files = {
        "proc/version": "Linux version 6.8.1-rt (gcc) #1 SMP PREEMPT_RT",
        "sys/kernel/realtime": "1",
        f"{CPU}/cpu0/cpufreq/scaling_governor": "performance",
        f"{CPU}/cpu1/cpufreq/scaling_governor": "performance",
        "sys/devices/system/clocksource/clocksource0/current_clocksource": "tsc",
        "dev/ttyUSB3": "",
        "sys/bus/usb-serial/devices/ttyUSB3/latency_timer": "16",
        "bin/ip": "",
    }
    for state, (latency, disabled) in enumerate([("0", "0"), ("50", "0"), ("900", "1")]):
        files |= {f"{CPU}/cpu0/cpuidle/state{state}/{name}": text for name, text in
                  {"latency": latency, "disable": disabled}.items()}  # fmt: skip
    for name in ("can0", "can1"):
        files |= {f"sys/class/net/{name}/flags": "0x40041", f"sys/class/net/{name}/tx_queue_len": "64"}
    for path, content in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(f"{content}\n")
    tells(tmp_path, LINK)
    (tmp_path / "bin/ip").chmod(0o755)
    link = tmp_path / "dev/serial/by-id/usb-IMU"
    link.parent.mkdir(parents=True)
    link.symlink_to("../../ttyUSB3")
    monkeypatch.setenv("PATH", f"{tmp_path}/bin:/usr/bin:/bin")
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1, 2, 3})
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"):
        monkeypatch.setenv(name, "")  # set anew, and taken back after the test
    monkeypatch.delenv("RMW_IMPLEMENTATION", raising=False)
    return tmp_path


LATE = [  # how many wake-ups are late, by s, and how that is judged
    (0, 0.0, Level.FINE),
    (2500, 0.0019, Level.FINE),  # less than half a period
    (2, 0.002, Level.FINE),
    (3, 0.002, Level.WARNING),
    (1, 0.024, Level.FINE),
    (1, 0.025, Level.WARNING),  # half of what lets the arm down
    (1, 0.05, Level.FAULT),
]


@pytest.mark.parametrize(("late", "by", "level"), LATE)
def test_wake_ups_are_judged_by_how_many_are_late_and_by_the_worst(late: int, by: float, level: Level):
    row = settings.of_wakeups(wakeups(late, by), 0.004, 0.05)
    assert row.level is level and bool(row.remedy) == bool(level)


DELAYS = {
    "kernel": {"proc/version": "Linux version 6.8.0 (gcc) #1 SMP PREEMPT_DYNAMIC", "sys/kernel/realtime": ""},
    "CPU governor": {f"{CPU}/cpu1/cpufreq/scaling_governor": "powersave"},
    "idle states": {f"{CPU}/cpu0/cpuidle/state2/disable": "0"},
    "clock source": {"sys/devices/system/clocksource/clocksource0/current_clocksource": "hpet"},
}


@pytest.mark.parametrize(("what", "change"), DELAYS.items(), ids=DELAYS)
def test_what_delays_threads_is_a_warning_only_where_they_were_late(computer, what: str, change: dict[str, str]):
    assert {row.level for row in of_computer(computer).values()} == {Level.FINE}  # it could not be better
    for path, content in change.items():
        (computer / path).write_text(content)
    for is_late, level in ((False, Level.NOTE), (True, Level.WARNING)):
        assert of_computer(computer, is_late)[what].level is level
    # A container states nothing of its CPUs: no fault
    assert max(row.level for row in of_computer(computer / "none", is_late=True).values()) is Level.UNKNOWN


def test_the_command_for_idle_states_names_those_that_are_too_deep_for_the_rate(computer):
    for state, latency in enumerate((2, 390, 410)):
        (computer / f"{CPU}/cpu0/cpuidle/state{state}/latency").write_text(f"{latency}")
    (computer / f"{CPU}/cpu0/cpuidle/state2/disable").write_text("0")
    row = of_computer(computer)["idle states"]
    assert row.found == "a CPU wakes up within 410 µs"
    assert row.remedy == "echo 1 | sudo tee /sys/devices/system/cpu/cpu*/cpuidle/state2/disable"


def test_limits_matter_only_where_a_thread_priority_is_asked_for_and_one_cpu_is_too_few(computer, monkeypatch):
    refused = IN_TIME._replace(refused=("thread_priority 50 is not permitted",))
    row = of_computer(computer, woken=refused, priority=50)["real-time limits"]
    assert row.level is Level.WARNING and "rtprio 99" in row.remedy
    for fine in ({}, {"priority": 50}):
        assert of_computer(computer, **fine)["real-time limits"].level is Level.FINE
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0})
    assert of_computer(computer)["CPUs for the nodes"].level is Level.WARNING


MIDDLEWARE = [  # the implementation, how far it reaches, what has opened it, and how that is judged
    ("rmw_fastrtps_cpp", "LOCALHOST", "", Level.FINE),
    ("rmw_zenoh_cpp", "LOCALHOST", "", Level.WARNING),
    ("rmw_fastrtps_cpp", "SUBNET", "EXO_GRAVITY_DISCOVERY_RANGE=SUBNET", Level.WARNING),
    ("rmw_fastrtps_cpp", "SUBNET", "", Level.FINE),  # SROS2 is enforced
    ("rmw_fastrtps_cpp", "OFF", "", Level.FAULT),
]


@pytest.mark.parametrize(("middleware", "reach", "opening", "level"), MIDDLEWARE)
def test_the_middleware_who_may_command_the_arm_and_the_multicast_of_the_simulated_bus(
    middleware: str, reach: str, opening: str, level: Level, monkeypatch
):
    monkeypatch.setattr(settings, "GROUP", "10.0.0.1")  # no multicast address: refused
    assert settings.of_multicast(True).level is Level.FAULT and settings.of_multicast(False).level is Level.FINE
    assert max(row.level for row in settings.of_middleware(middleware, reach, opening)) is level


@pytest.mark.parametrize("tool", ["doctor", "launcher"])
@pytest.mark.parametrize(
    ("variable", "value", "said"),
    [
        ("ROS_DOMAIN_ID", "300", "ROS_DOMAIN_ID = '300': must be a whole number from 0 to 232"),
        ("ROS_DOMAIN_ID", "lab", "ROS_DOMAIN_ID = 'lab': must be a whole number from 0 to 232"),
        ("HOME", "/proc/nohome", "'/proc/nohome/.ros/log': must be a folder that can be made"),
        ("RMW_IMPLEMENTATION", "rmw_none_cpp", "RMW_IMPLEMENTATION = 'rmw_none_cpp': must be installed"),
    ],
)
def test_an_environment_that_would_end_every_node_is_refused_before_one_starts(
    run_tool, monkeypatch, tool, variable, value, said
):
    for name in ("ROS_LOG_DIR", "ROS_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(variable, value)
    code, _, err = run_tool(tool)
    assert code == 2 and said in err


@pytest.mark.parametrize(("rate", "level"), [(250, Level.FINE), (900, Level.WARNING), (1100, Level.FAULT)])
def test_the_bus_load_at_the_wanted_rate(rate: float, level: Level):
    row = settings.of_load("/right/can_bridge", Traffic(4), rate)
    assert row.level is level and ("826" in row.remedy) == bool(level)  # the table of docs/wiring.md


INTERFACE = {  # what `ip` reports, changes of files, what is bad, its level, and the command that makes it good
    "fine": ({}, {}, "", Level.FINE, ""),
    "error passive": ({"state": "ERROR-PASSIVE"}, {}, "state", Level.WARNING, "termination"),
    "bus off": ({"state": "BUS-OFF"}, {}, "state", Level.FAULT, "up type can bitrate 1000000"),
    "bit rate": ({"bittiming": {"bitrate": 500_000}}, {}, "bit rate", Level.FAULT, "bitrate 1000000"),
    "no restart": ({"restart_ms": 0}, {}, "restart", Level.WARNING, "restart-ms 100"),
    "short queue": ({}, {"tx_queue_len": "10"}, "txqueuelen", Level.WARNING, "txqueuelen 50"),
    "long queue": ({}, {"tx_queue_len": "1000"}, "txqueuelen", Level.WARNING, "txqueuelen 50"),
    "down": ({}, {"flags": "0x40040"}, "state", Level.FAULT, "up"),
}


@pytest.mark.parametrize(("link", "files", "what", "level", "command"), INTERFACE.values(), ids=INTERFACE)
def test_what_ip_and_the_kernel_report_of_an_interface(computer, link, files, what, level, command):
    tells(computer, {"linkinfo": {"info_data": {**LINK["linkinfo"]["info_data"], **link}}})
    for name, content in files.items():
        (computer / "sys/class/net/can1" / name).write_text(f"{content}\n")
    bad, worst = of_interface(computer)
    assert list(bad) == [f"can1: {what}"] * bool(what) and worst is level
    assert not what or command in bad[f"can1: {what}"].remedy


def test_an_interface_that_is_missing_or_virtual_or_of_which_nothing_is_told(computer):
    tells(computer, {})
    assert of_interface(computer)[1] is Level.UNKNOWN
    tells(computer, {"linkinfo": {"info_kind": "vcan"}})
    (computer / "sys/class/net/can1/flags").write_text("0x40040\n")
    assert of_interface(computer)[0]["can1: state"].remedy == "sudo ip link set can1 up"
    shutil.rmtree(computer / "sys/class/net/can1")
    bad, worst = of_interface(computer)
    assert worst is Level.FAULT and list(bad) == ["can1"]


@pytest.fixture
def run(computer, params_with, monkeypatch, capsys):
    """Run doctor there on a packaged file, with wake-ups in time or as given; return its code and text.

    python-can has a bus within the process for each interface of SocketCAN.
    """
    monkeypatch.setitem(BACKENDS, "socketcan", ("can.interfaces.virtual", "VirtualBus"))

    def run(file: str = "exo.yaml", node: str = "/right/can_bridge", *, woken: Wakeups = IN_TIME, **changes: object):
        monkeypatch.setattr(settings, "measured", lambda *_: woken)
        code = doctor.main(["--params", str(params_with(file, {node: changes}))], computer)
        output = capsys.readouterr()
        return code, output.out + output.err

    return run


def test_the_code_is_0_where_all_is_well_1_with_a_warning_and_2_with_a_fault_each_with_its_command(run, computer):
    code, text = run()
    assert code == 0 and text.splitlines()[-1] == "Fine"
    assert "can1: bit rate" in text and "24% at 250 Hz" in text
    assert [line.split("  ")[0] for line in text.splitlines() if "bus load" in line] == ["fine"] * 2
    (computer / "sys/class/net/can1/tx_queue_len").write_text("10\n")
    code, text = run()
    assert code == 1 and "-> sudo ip link set can1 txqueuelen 50\n" in text
    code, text = run(woken=wakeups(1, 0.06))
    assert code == 2 and "No one may wear an arm" in text


def test_a_serial_adapter_that_keeps_bytes_is_found_by_its_name(computer):
    port = settings.of_port("/dev/serial/by-id/usb-IMU", computer)
    assert port.level is Level.WARNING
    assert "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB3/latency_timer" in port.remedy
    (computer / "dev/ttyUSB3").unlink()
    assert settings.of_port("/dev/serial/by-id/usb-IMU", computer).level is Level.FAULT


BUS = {"interface": "udp_multicast", "channel": "239.74.163.2"}
INTERFACES = {  # the case, changes of `can`, what is found, and what is to be done
    "misspelt": ({"interface": "socket_can", "channel": "can0"}, "no interface socket_can", "one of canalystii, "),
    "no driver": (
        {"interface": "canalystii", "channel": "0", "options": {"bitrate": 1_000_000}},
        "no driver: ", "pip install 'python-can[canalystii]'",
    ),
    "no adapter": ({"interface": "slcan", "channel": "/dev/no", "options": {"bitrate": 10**6}}, "No such file", "plug"),
    "another adapter": ({**BUS, "serial": "A1"}, "must be can.serial = A1", "plug the adapter in"),
}  # fmt: skip


@pytest.mark.parametrize(("can", "found", "remedy"), INTERFACES.values(), ids=INTERFACES)
def test_an_interface_that_does_not_open_is_a_fault_with_what_opens_it(run, can, found, remedy):
    options = {"port": next(PORTS), "hop_limit": 0} if can["interface"] == BUS["interface"] else {}
    code, text = run("sim.yaml", can={"options": options, **can}, command_timeout=0.1, frozen_timeout=0.1)
    row, advice = next(pair for pair in pairwise(text.splitlines()) if ": opens" in pair[0])
    assert code == 2 and row.startswith("fault") and found in row and remedy in advice


def test_a_bus_that_a_bridge_holds_is_left_alone_and_the_last_line_says_that_not_all_was_tried(run):
    options = {"port": next(PORTS), "hop_limit": 0}
    lock = BusLock((BUS["interface"], BUS["channel"], options), "/right/can_bridge (PID 7)")
    code, text = run("sim.yaml", can={**BUS, "options": options})
    lock.release()
    (row,) = (line for line in text.splitlines() if ": opens" in line)
    assert row.startswith("unknown") and "not tried: held by /right/can_bridge (PID 7)" in row
    assert code == 0 and text.splitlines()[-1] == "Nothing is wrong in what could be tried; unknown: 1"


@pytest.mark.parametrize(("file", "level"), [("sim.yaml", "warning"), ("exo.yaml", "fault")])
def test_a_node_that_waits_for_a_clock_is_named(run, file, level):
    (row,) = (line for line in run(file, use_sim_time=True)[1].splitlines() if "use_sim_time  " in line)
    assert row.startswith(level) and "a program that publishes /clock" in row


def test_it_measures_in_a_separate_process_at_the_rate_of_the_file():
    woken = settings.measured(0.01, 0.2, 0)
    assert woken.lateness.shape == (20,) and (woken.lateness > -1e-6).all() and not woken.refused
