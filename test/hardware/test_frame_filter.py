"""Which frames count as replies, as commands of another sender, and as echoes of our own commands."""

from __future__ import annotations

import can
import pytest

from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.motors.specs import MOTORS
from exo_gravity.hardware.can.motor_bus import FOREIGN_COMMAND, FrameFilter

from ..support.simulated_device import frame

MOTORS_ON_BUS = tuple(JointMotor(MOTORS["AK60-6"], can_id) for can_id in (1, 2))
COMMAND = MOTORS_ON_BUS[0].command(1.0, 0.0)


def marked() -> can.Message:
    """A command with the mark that some buses set on an echo, and SocketCAN on each frame from this computer."""
    return frame(1, COMMAND, is_rx=False)


def test_a_marked_command_is_an_echo_on_a_bus_that_marks_only_echoes() -> None:
    assert FrameFilter(MOTORS_ON_BUS).sort(marked()) == ("echo", 0)


def test_on_socketcan_a_marked_command_that_we_did_not_send_is_foreign() -> None:
    assert FrameFilter(MOTORS_ON_BUS, marks_echoes=False).sort(marked()) == (FOREIGN_COMMAND, 1)


@pytest.mark.parametrize("marks_echoes", [True, False])
def test_a_command_that_we_sent_is_an_echo_when_it_comes_back(marks_echoes: bool) -> None:
    frames = FrameFilter(MOTORS_ON_BUS, marks_echoes)
    frames.sent((1, COMMAND))
    assert frames.sort(frame(1, COMMAND)) == ("echo", 0)
    assert frames.sort(frame(1, COMMAND)) == (FOREIGN_COMMAND, 1)
