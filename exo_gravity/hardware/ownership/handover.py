"""Letting down an arm that another process has left with its motors on: AK motors keep applying the last command.

The watchdog does it for a bridge that has died, and a new bridge does it if both had died.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import can

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.joint_motor import JointMotor, peaks_of
from exo_gravity.core.safety.delivery import ABSOLUTE, RELATIVE
from exo_gravity.core.safety.drive import Drive
from exo_gravity.core.safety.limits import JointSample, Limits
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.hardware.can.motor_bus import MotorBus, open_bus
from exo_gravity.hardware.control_loop import ControlLoop

OPEN_PERIOD = 0.05  # s between two attempts to open the bus
FIRST_REPLIES = 0.05  # s in which the motors must reply to the first commands
CHECK_PERIOD = 0.05  # s
RETRY_PERIOD = 0.25  # s between two attempts to reach a motor that does not reply, however long it takes


class Charge(NamedTuple):
    """The arm to let down: its bus (interface, channel, options), motors, limits, and control period in s."""

    address: tuple[str, str, Mapping[str, Any]]
    motors: Sequence[JointMotor]
    limits: Limits
    period: float

    def open(self) -> can.BusABC:
        """Open the python-can bus. Raises BusError."""
        return open_bus(*self.address)


def let_down(
    charge: Charge,
    drive: Drive,
    note: Callable[[Drive], None] = lambda drive: None,
    log: Callable[[str], None] = lambda text: None,
    is_endless: bool = True,
) -> bool:
    """Let down an arm whose motors apply `drive`; return whether its motors have confirmed that they are off.

    note: called with each drive. log: called with each change worth knowing. is_endless: whether to keep trying while
    the bus or a motor cannot be reached.
    """
    try:
        bus = _open(charge, log, is_endless)
    except BusError as error:
        log(str(error))
        return False
    motors = MotorBus(bus, charge.motors, powered=True, note=note, reopen=charge.open)
    machine = SafetyMachine(charge.limits, charge.period, peaks_of(charge.motors))
    machine.take_over(*_applied(motors, drive, charge.period), time.monotonic())
    loop = ControlLoop(motors, machine, charge.period)
    loop.start()
    was_unreached = False
    while loop.is_alive and not loop.is_off:
        if machine.is_unreached and not was_unreached:
            log("a motor does not reply; it may still be powered; trying again")
        was_unreached = machine.is_unreached
        if was_unreached and not is_endless:
            loop.abandon()
            return False
        loop.period = RETRY_PERIOD if was_unreached else charge.period
        time.sleep(CHECK_PERIOD)
    loop.stop()
    return not motors.may_be_powered


def _open(charge: Charge, log: Callable[[str], None], is_endless: bool) -> can.BusABC:
    is_first = True
    while True:
        try:
            return charge.open()
        except BusError as error:
            if not is_endless:
                raise
            if is_first:
                log(f"{error}; the motors may still be powered; trying again")
            is_first = False
            time.sleep(OPEN_PERIOD)


def _applied(motors: MotorBus, drive: Drive, period: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the effort (4,) in Nm and damping (4,) in Nm s/rad that the motors apply, which received `drive`.

    A motor that replies another torque has been switched off or obeyed another sender. Then its reply counts.
    """
    end = time.monotonic() + FIRST_REPLIES
    is_complete = False
    while not is_complete and time.monotonic() < end:
        try:
            is_complete = motors.exchange(drive._replace(powered=True), time.monotonic() + period)
        except BusError:
            time.sleep(period)
    effort, damping = list(drive.effort), list(drive.damping)
    for i, joint in enumerate(motors.samples):
        if not _is_as_noted(joint, effort[i], damping[i]):
            effort[i], damping[i] = joint.effort, 0.0
    return tuple(effort), tuple(damping)


def _is_as_noted(joint: JointSample, effort: float, damping: float) -> bool:
    """Return whether the reply shows the noted effort and damping; true without a reply."""
    expected = effort - damping * joint.velocity
    return not abs(joint.effort - expected) > ABSOLUTE + RELATIVE * abs(expected)
