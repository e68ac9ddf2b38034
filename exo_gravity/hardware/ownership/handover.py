"""Letting down an arm that another process has left with its motors on: AK motors keep applying the last command.

The watchdog does it for a bridge that has died, and a new bridge does it if both had died.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import can

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.joint_motor import JointMotor, peaks_of
from exo_gravity.core.safety.delivery import ABSOLUTE, RELATIVE
from exo_gravity.core.safety.drive import Drive
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.hardware.can.can_port import open_bus
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock
from exo_gravity.hardware.control_loop import ControlLoop
from exo_gravity.hardware.ownership.bus_lock import Address

OPEN_PERIOD = 0.05  # s between two attempts to open the bus
FIRST_REPLIES = 0.05  # s in which the motors must reply to the first commands
RETRY_PERIOD = 0.25  # s between two attempts to reach a motor that does not reply, however long it takes


@dataclass(frozen=True)
class ArmOnBus:
    """An arm that may have to be let down, and how to reach it."""

    address: Address  #: Of its bus.
    motors: Sequence[JointMotor]  #: From shoulder to elbow.
    limits: Limits  #: That it must never exceed.
    period: float  #: s of a control cycle.

    def open(self) -> can.BusABC:
        """Open the python-can bus. Raises BusError."""
        return open_bus(*self.address)


def let_down(
    arm: ArmOnBus,
    drive: Drive,
    note: Callable[[Drive], None] = lambda drive: None,
    log: Callable[[str], None] = lambda text: None,
    is_endless: bool = True,
    clock: Clock = COMPUTER_CLOCK,
    is_wanted: Callable[[], bool] = lambda: False,
) -> bool:
    """Let down an arm whose motors apply `drive`; return whether its motors have confirmed that they are off.

    note: called with each drive. log: called with each change worth knowing. is_endless: whether to keep trying while
    the bus or a motor cannot be reached. is_wanted: whether someone else waits for the bus, who then gets his chance.
    """
    try:
        bus = _open(arm, log, is_endless, clock, is_wanted)
    except BusError as error:
        log(str(error))
        return False
    motors = MotorBus(bus, arm.motors, powered=True, note=note, reopen=arm.open, clock=clock)
    machine = SafetyMachine(arm.limits, arm.period, peaks_of(arm.motors))
    machine.take_over(*_applied(motors, drive, arm.period), clock.monotonic())
    loop = ControlLoop(motors, machine, arm.period)
    was_unreached, incomplete = False, 0
    while not loop.is_off and loop.cycle():
        if machine.is_unreached and not was_unreached:
            log("a motor does not reply; it may still be powered; trying again")
        was_unreached = machine.is_unreached
        if was_unreached and (not is_endless or is_wanted()):
            loop.abandon()
            return False
        # Once every motor has replied, the next cycle must come before their replies are too old.
        loop.period = RETRY_PERIOD if was_unreached and loop.incomplete > incomplete else arm.period
        incomplete = loop.incomplete
    loop.stop()
    return not motors.may_be_powered


def _open(
    arm: ArmOnBus, log: Callable[[str], None], is_endless: bool, clock: Clock, is_wanted: Callable[[], bool]
) -> can.BusABC:
    is_first = True
    while True:
        try:
            return arm.open()
        except BusError as error:
            if not is_endless or is_wanted():
                raise
            if is_first:
                log(f"{error}; the motors may still be powered; trying again")
            is_first = False
            clock.sleep(OPEN_PERIOD)


def _applied(motors: MotorBus, drive: Drive, period: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the effort (4,) in Nm and damping (4,) in Nm s/rad that the motors apply, which received `drive`.

    A motor that replies another torque has been switched off or obeyed another sender. Then its reply is used.
    """
    clock = motors.clock
    end = clock.monotonic() + FIRST_REPLIES
    first = drive._replace(powered=True, unsure=(True,) * len(drive.effort))
    is_complete = False
    while not is_complete and clock.monotonic() < end:
        try:
            is_complete = motors.exchange(first, clock.monotonic() + period)
        except BusError:
            clock.sleep(period)
    effort, damping = list(drive.effort), list(drive.damping)
    for i, joint in enumerate(motors.samples):
        expected = effort[i] - damping[i] * joint.velocity
        if abs(joint.effort - expected) > ABSOLUTE + RELATIVE * abs(expected):  # not without a reply: that is NaN
            effort[i], damping[i] = joint.effort, 0.0
    return tuple(effort), tuple(damping)
