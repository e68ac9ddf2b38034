# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The arm on two computers over better and worse wires, before a release: `python -m test.two_computers [CASE ...]`.

    robot eth0 -- veth -- [ wire ] -- veth -- eth0 desk

Bridge, IMU, simulated device and recorder are on the robot; compensator and wearer on the desk. Each computer is a
network namespace without another interface, so that nothing leaves this machine. The kernel may lack netem: the wire is
a process, which passes Ethernet frames late, and not all of them. In each case the virtual wearer brings the arm to a
pose and lets go; the simulator's truth judges it. Exit code 1 at the first case that differs although this machine kept
up. Needs root, or `unshare --map-root-user` in front.
"""

import json
import os
import random
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from .support import ROOT
from .support.launched_nodes import SIMULATED, LaunchedNodes, executable
from .support.stalls import Machine
from .support.truth import Truth

ADDRESSES = {"desk": "10.77.0.2", "robot": "10.77.0.1"}
PARTS = {
    "desk": ("/right/compensator", "/right/wearer"),
    "robot": ("/imu", "/right/can_bridge", "/right/simulator", "/robot/recorder"),
}
POSE, MOVE, HOLD = [0.1, 0.8, 0.7, 0.6], 2.0, 8.0  # rad, s, s
# As config/sim.yaml, for a busy computer, but efforts may be no older than on a real arm.
TIMING = {**SIMULATED, "can_bridge": {**SIMULATED["can_bridge"], "command_timeout": 0.05}}
HOLDER = ("sh", "-c", "echo ready; read _")  # ends with its standard input, and with it the namespace
EVERY_PROTOCOL, OUTGOING, ARP, IPV4, UDP = 0x0003, 4, b"\x08\x06", b"\x08\x00", 17


@dataclass(frozen=True)
class Case:
    """delay: ms one way. jitter: ms added at random, at most. loss: share each way. Packets keep their order.

    peer: the computer that the robot names. carried: what must come out, None if chance decides.
    """

    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    carried: bool | None = True
    peer: str = ADDRESSES["desk"]


CASES = [
    Case(),
    Case(5.0, 2.0, 0.02),
    Case(15.0),
    Case(loss=0.1, carried=None),  # four or five packets in a row let it down every 10 to 50 s on average
    Case(10.0, 10.0, carried=None),
    Case(20.0, carried=False),
    Case(10.0, 5.0, 0.1, carried=False),
    Case(carried=False, peer=""),  # a desk that names the robot does not command one that names no peer
]


def without_checksum(frame: bytes) -> bytes:
    """Set the UDP checksum to 0, none (RFC 768): a frame to a virtual interface may lack what hardware would add."""
    if frame[12:14] != IPV4 or frame[23] != UDP or (frame[20] & 0x1F) or frame[21]:  # not UDP, or a later fragment
        return frame
    checksum = 14 + 4 * (frame[14] & 0x0F) + 6
    return frame[:checksum] + b"\0\0" + frame[checksum + 2 :]


def pass_on(case: Case) -> None:
    """Be the wire until the standard input closes; print how many frames were lost, and ms of the latest."""
    ends = [socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(EVERY_PROTOCOL)) for _ in ADDRESSES]
    for name, end in zip(ADDRESSES, ends, strict=True):
        end.bind((name, EVERY_PROTOCOL))
    assert Path("/proc/sys/net/ipv4/ip_forward").read_text() == "0\n", "the wire is not the only way"
    os.setpriority(os.PRIO_PROCESS, 0, -20)  # as the nodes
    print("ready", flush=True)
    dice, lost, latest, ready = random.Random(1), 0, 0.0, list[Any]()
    queues = {end: deque[tuple[float, bytes]]() for end in ends}  # frames from there, and when each is due
    while sys.stdin not in ready:
        ready = select.select([*ends, sys.stdin], [], [], 0.0005)[0]
        for source, target in (ends, ends[::-1]):
            queue, now = queues[source], time.monotonic()
            frame, address = source.recvfrom(65_535) if source in ready else (b"", (0, 0, OUTGOING))
            is_lost = frame[12:14] != ARP and address[2] != OUTGOING and dice.random() < case.loss
            lost += is_lost
            if address[2] != OUTGOING and not is_lost:  # not what this process sends itself
                due = now + 1e-3 * (case.delay + case.jitter * dice.random())
                queue.append((max(due, queue[-1][0] if queue else due), without_checksum(frame)))
            while queue and queue[0][0] <= now:
                due, frame = queue.popleft()
                latest = max(latest, now - due)
                target.send(frame)
    print(json.dumps([lost, 1e3 * latest]), flush=True)


@contextmanager
def network(case: Case, traffic: list[float]) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Yield a function that starts a command on a computer; `traffic` is what `pass_on` prints at the end."""
    holders: dict[str, subprocess.Popen[str]] = {}

    def start(computer: str, *command: str, out: Any = subprocess.PIPE, **environment: str) -> subprocess.Popen[str]:
        inside = ["nsenter", "--target", str(holders[computer].pid), "--net"] if computer else []
        given = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
        return subprocess.Popen([*inside, *command], env=given, cwd=ROOT, stdin=subprocess.PIPE, stdout=out, text=True)

    def hold(name: str, process: subprocess.Popen[str]) -> None:
        holders[name] = process
        assert process.stdout is not None and process.stdout.readline() == "ready\n", process.args

    def ip(computer: str, arguments: str) -> str:
        return start(computer, "ip", *arguments.split()).communicate()[0]

    try:
        hold("wire", start("", "unshare", "--net", *HOLDER))
        for name, address in ADDRESSES.items():
            hold(name, start("", "unshare", "--net", *HOLDER))
            ip("wire", f"link add {name} type veth peer name eth0 netns {holders[name].pid}")
            ip("wire", f"link set {name} up")
            route = "route add 224.0.0.0/4 dev eth0"  # for the CAN bus over UDP, whose frames never leave
            for arguments in ("link set lo up", f"address add {address}/24 dev eth0", "link set eth0 up", route):
                ip(name, arguments)
            assert {link["ifname"] for link in json.loads(ip(name, "-json link"))} == {"lo", "eth0"}
            assert "default" not in ip(name, "route")
        figures = map(str, (case.delay, case.jitter, case.loss))
        hold("passing", start("wire", sys.executable, "-m", "test.two_computers", "--wire", *figures))
        yield start
        traffic += json.loads(holders["passing"].communicate("")[0])
    finally:
        spaces = {os.readlink(f"/proc/{holders[name].pid}/ns/net") for name in ("wire", *ADDRESSES) if name in holders}
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                if os.readlink(process / "ns/net") in spaces:
                    os.kill(int(process.name), signal.SIGKILL)


def play(case: Case, folder: Path) -> tuple[str, list[str]]:
    """Return a row of the table, and what differs from what must come out. The files stay in `folder`."""
    script = folder / "hold.yaml"
    script.write_text(yaml.safe_dump({"name": "hold", "steps": [{"move": POSE, "over": MOVE}, {"hold": HOLD}]}))
    nodes = LaunchedNodes(folder, timing=TIMING, truth=True, simulator={"trial": str(script), "trial_delay": 3.0})
    nodes.add("/robot/recorder", output=str(folder / "bag"), live=True)
    line: dict[str, Any] = {}
    log, bridge, action, traffic, ages = "", dict[str, str](), "", list[float](), list[float]()
    end = time.time() + 40.0 + MOVE + HOLD
    with network(case, traffic) as start, (folder / "desk.txt").open("w") as desk:
        command = (executable("launcher"), "--params", str(nodes.path), "--only")
        other = start("desk", *command, *PARTS["desk"], out=desk, ROS_STATIC_PEERS=ADDRESSES["robot"])
        robot = start("robot", *command, *PARTS["robot"], ROS_STATIC_PEERS=case.peer)
        for text in robot.stdout or ():
            log += text
            _, brace, rest = text.partition(" {")
            if brace:  # of the recorder, ten times a second
                with suppress(ValueError):  # two lines in one
                    line = json.loads("{" + rest)
                bridge = line.get("status", {}).get("right/can_bridge", {})
                action = line.get("right", {}).get("step", {}).get("action", "")
                age = bridge.get("age of efforts (ms)", "none")
                ages += [float(age)] if action == "hold" and age != "none" else []
            failed = {bridge.get("fault", "none"), bridge.get("refusal", "none")} != {"none"}
            if failed or action == "done" or time.time() > end:
                break
        end = time.time()
        for launcher in (robot, other):  # the robot first: it lets the arm down
            launcher.terminate()
            launcher.communicate(timeout=60.0)
    outcome = "carried" if action == "done" else f"{bridge.get('fault')}, {bridge.get('message')}"
    truth = Truth(nodes.truth_path())
    records = truth.since(end - HOLD + 0.5)
    position = np.degrees(records["position"][records["time"] <= end])
    drift = float(np.ptp(position, axis=0).max()) if action == "done" else 0.0
    median, largest = np.percentile(ages, (50, 100)) if ages else (np.nan, np.nan)
    problems = {
        f"must {'' if case.carried else 'not '}be carried": case.carried not in ((action == "done"), None),
        "the motors are on": not truth.motors_are_off(),
        "a joint was fast": np.abs(truth.since(0.0)["velocity"]).max() > 2.0,
        "drift": drift > 0.5,
        "the warning of other hosts": ("other hosts can command this arm" in log) != bool(case.peer),
        "answers came earlier than the wire permits": median < 2.0 * case.delay,
        "nothing was lost": bool(case.loss) and not traffic[0],
    }
    wire, figures = f"{case.delay:g} | {case.jitter:g} | {100.0 * case.loss:g}", f"{median:.1f} / {largest:.1f}"
    row = f"| {wire} | {outcome} | {figures} | {drift:.2f} | {traffic[1]:.0f} |"
    return row, [problem for problem, is_there in problems.items() if is_there]


def main(*cases: str) -> None:
    """Play the cases, by their numbers, and print the table."""
    print("delay one way ms | jitter ms | loss % | outcome | efforts ms: median / largest | drift deg | late ms")
    machine = Machine()
    for number in map(int, cases or range(len(CASES))):
        with tempfile.TemporaryDirectory() as folder, machine.keeps_up():
            row, problems = play(CASES[number], Path(folder))
            print(row, *problems, flush=True)
            assert not problems, problems


if __name__ == "__main__":
    if sys.argv[1:2] == ["--wire"]:
        delay, jitter, loss = map(float, sys.argv[2:])
        pass_on(Case(delay, jitter, loss))
    else:
        main(*sys.argv[1:])
