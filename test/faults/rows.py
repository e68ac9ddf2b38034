"""The fault matrix: what is done to a carried arm, and what must come of it."""

import math
import multiprocessing
import os
import random
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import can
from geometry_msgs.msg import Vector3Stamped
from sensor_msgs.msg import JointState

from ..faults.stages import Commanded, Launched, OtherClock, Split, Stage

NOTICED = 0.10  # s from a fault to the safe action,
DEAD = 0.15  # or where a process must be noticed dead
STATES, EFFORTS = "/right/joint_states", "/right/effort_commands"
FLOOD = 3000  # frames per second beside our own 2,000: what two cores can hear in five Python processes


@dataclass(frozen=True)
class Row:
    """A fault. do(stage) brings it about; undo(stage) ends it, where the stage is to be used again.

    within: s until the arm must be let down, None where it may as well stay carried: what is refused or ignored.
    short: whether the tests play it too. spent: whether the stage can't be used again, though its nodes run on.
    """

    name: str
    do: Callable[[Stage], None]
    on: type[Stage] = Stage
    within: float | None = NOTICED
    undo: Callable[[Stage], None] = lambda stage: None
    short: bool = False
    spent: bool = False


def send(node, number):
    return lambda stage: stage.process(node).send_signal(number)


def parameter(**values):
    return lambda stage: stage.watcher.set("simulator", **values)


def spoil(change):
    return lambda stage: setattr(stage, "spoil", change)


def publish(kind, topic, make):
    """Publish what `make(stage)` returns, for half a second, from a publisher that nobody has asked for."""

    def do(stage):
        node = stage.watcher.node
        publisher = node.create_publisher(kind, topic, 1)
        stage.watcher.until(lambda: publisher.get_subscription_count() > 0)
        for _ in range(50):  # one message alone may be overwritten by the next before it is read, and does nothing
            publisher.publish(make(stage))
            time.sleep(0.01)

    return do


def elsewhere(position):
    def make(stage):
        state = stage.watcher.joints[-1]
        return JointState(header=state.header, name=state.name, position=position)

    return make


def tilted(angle):
    def make(stage):
        message = Vector3Stamped()
        message.vector.y = angle
        return message

    return make


def flood(count, ids, seed=1):
    """Send `count` frames, `FLOOD` a second, from a process of its own."""

    def do(stage):
        process = multiprocessing.get_context("spawn").Process(
            target=_flood, args=(stage.stacks[0].bus, count, ids, seed)
        )
        process.start()
        stage.watcher.until(lambda: not process.is_alive())

    return do


def _flood(bus, count, ids, seed):
    dice = random.Random(seed)
    with can.Bus(**bus) as wire:
        start = time.monotonic()
        for number in range(count):
            data = dice.randbytes(dice.randrange(9))
            wire.send(can.Message(arbitration_id=dice.choice(ids), data=data, is_extended_id=dice.random() < 0.2))
            time.sleep(max(0.0, start + number / FLOOD - time.monotonic()))


def overload(stage):
    """Keep every processor busy four times over for 3 s."""
    spinners = [multiprocessing.get_context("spawn").Process(target=_spin, args=(3.0,)) for _ in range(8)]
    for spinner in spinners:
        spinner.start()
    for spinner in spinners:
        spinner.join()


def _spin(seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass


def hostile_parameters(stage):
    bad = ({"robot__mass": [-1.0] * 4}, {"robot__mass": [math.nan] * 4}, {"gain": [1.0] * 3}, {"mode": 7}, {"law": ""})
    for values in bad:
        assert not stage.watcher.set("compensator", **values).successful


def kill_watchdog(stage):
    bridge = stage.process("can_bridge").pid
    (children,) = Path(f"/proc/{bridge}/task").glob(f"{bridge}/children")
    os.kill(int(children.read_text().split()[0]), signal.SIGKILL)


ROWS = (
    Row("compensator killed", send("compensator", signal.SIGKILL), Stage, DEAD),
    Row("second publisher of efforts", publish(JointState, EFFORTS, lambda s: s.watcher.efforts[-1]), Split,
        short=True),
    Row("compensator frozen, alone", send("compensator", signal.SIGSTOP), Split,
        undo=send("compensator", signal.SIGCONT), short=True),
    Row("compensator killed, alone", send("compensator", signal.SIGKILL), Split, spent=True),
    Row("can_bridge killed", send("can_bridge", signal.SIGKILL), within=DEAD, short=True),
    Row("can_bridge frozen", send("can_bridge", signal.SIGSTOP), within=DEAD),
    Row("can_bridge told to end", send("can_bridge", signal.SIGTERM), within=DEAD),
    Row("watchdog killed", kill_watchdog, within=DEAD),
    Row("launcher killed", lambda stage: stage.stacks[0].process.kill(), Launched, DEAD),
    Row("launcher interrupted", lambda stage: stage.stacks[0].process.send_signal(signal.SIGINT), Launched, DEAD),
    Row("imu killed", send("imu", signal.SIGKILL), within=DEAD),
    Row("imu frozen", send("imu", signal.SIGSTOP), within=DEAD, undo=send("imu", signal.SIGCONT)),
    Row("one motor silent", parameter(fault__unplugged=[False, False, True, False]),
        undo=parameter(fault__unplugged=[False] * 4)),
    Row("whole bus silent", parameter(fault__bus_silent=True), undo=parameter(fault__bus_silent=False)),
    Row("motor reports an error", parameter(fault__error=[0, 0, 5, 0]), undo=parameter(fault__error=[0] * 4)),
    Row("motor at 95 degC", parameter(fault__temperature=[30.0, 95.0, 30.0, 30.0]),
        undo=parameter(fault__temperature=[30.0] * 4)),
    Row("second publisher of joint states", publish(JointState, STATES, elsewhere([1.0] * 4))),
    Row("joint states that are NaN", publish(JointState, STATES, elsewhere([math.nan] * 4)), within=None),
    Row("second publisher of the tilt", publish(Vector3Stamped, "/imu/pitch_yaw", tilted(1.0))),
    Row("a tilt that is NaN", publish(Vector3Stamped, "/imu/pitch_yaw", tilted(math.nan)), within=None),
    Row("impossible parameters", hostile_parameters, within=None),
    Row("100,000 random frames", flood(100_000, (0, *range(5, 2048))), within=None),  # 1 to 4 would command motors
    Row("foreign frames, 3,000 a second", flood(15_000, range(0x100, 0x200)), within=None),
    Row("processors overloaded", overload, within=None),
    Row("effort NaN", spoil(lambda m: m.effort.__setitem__(1, math.nan)), Commanded, short=True),
    Row("effort infinite", spoil(lambda m: m.effort.__setitem__(1, math.inf)), Commanded),
    Row("effort of 1e308 Nm", spoil(lambda m: m.effort.__setitem__(1, 1e308)), Commanded),
    Row("three efforts", spoil(lambda m: m.effort.pop()), Commanded),
    Row("a wrong name", spoil(lambda m: m.name.__setitem__(3, "left_knee")), Commanded),
    Row("a name twice", spoil(lambda m: m.name.__setitem__(3, m.name[2])), Commanded),
    Row("no names", spoil(lambda m: setattr(m, "name", [])), Commanded),
    Row("no efforts", spoil(lambda m: setattr(m, "effort", [])), Commanded),
    Row("stamps an hour old", spoil(lambda m: setattr(m.header.stamp, "sec", m.header.stamp.sec - 3600)), Commanded),
    Row("stamps of tomorrow", spoil(lambda m: setattr(m.header.stamp, "sec", m.header.stamp.sec + 86400)), Commanded),
    Row("clock set back an hour", lambda stage: setattr(stage, "shift", -3600.0), OtherClock, None),
    Row("clock set ahead an hour", lambda stage: setattr(stage, "shift", 3600.0), OtherClock, None),
)  # fmt: skip
