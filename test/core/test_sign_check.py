"""The sign check on a hanging joint: both ways, and not fooled by a wearer who moves it."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from exo_gravity.core.safety.drive import Fault
from exo_gravity.core.safety.gate import MAX_DISTURBED, MIN_PUSH, SignCheck
from exo_gravity.core.safety.limits import JointSample

PERIOD = 0.004  # s
NAMES = ("a", "b", "c", "d")


class Joint:
    """The first joint alone: it yields at 0.2 rad/s per Nm beyond `friction`, and to a `hand`: rad/s at a time in s."""

    def __init__(self, hand: Callable[[float], float] = lambda now: 0.0, friction: float = 0.3) -> None:
        self.check = SignCheck(NAMES, (1.5, 0.0, 0.0, 0.0))
        self.pushes: list[float] = []
        self._hand = hand
        self._friction = friction
        self._position = self._now = 0.0

    def run(self, seconds: float) -> Fault | None:
        """Run the check for `seconds` or until it ends; return its fault."""
        for _ in range(round(seconds / PERIOD)):
            effort = self.check.effort[0]
            self.pushes.append(effort)
            yielding = effort - max(-self._friction, min(self._friction, effort))
            self._position += (0.2 * yielding + self._hand(self._now)) * PERIOD
            self._now += PERIOD
            sample = JointSample(self._position, 0.0, effort, 30, 0, self._now)
            fault = self.check.step(PERIOD, (sample,) * 4)
            if fault or self.check.done:
                return fault
        return None


def test_a_joint_passes_after_a_push_each_way_and_is_released():
    joint = Joint()
    assert joint.run(20.0) is None
    assert joint.check.done
    assert max(joint.pushes) > MIN_PUSH and min(joint.pushes) < -MIN_PUSH
    assert joint.check.effort[0] == 0.0


def test_a_joint_that_the_wearer_moves_before_it_is_pushed_proves_nothing():
    joint = Joint(hand=lambda now: 0.5 if 0.2 < now < 0.3 else 0.0, friction=10.0)
    assert joint.run(1.0) is None
    assert not joint.check.done
    assert "hold still" in joint.check.hint
    fault = joint.run(20.0)
    assert fault is not None and fault.code == "sign_unproven"


def test_a_wearer_who_keeps_moving_the_joint_is_asked_to_hold_still_and_then_refused():
    joint = Joint(hand=lambda now: 1.0 if now % 0.5 > 0.25 else 0.0, friction=10.0)
    fault = joint.run(60.0)
    assert fault is not None and fault.code == "sign_unproven"
    assert "hold still" in fault.reason
    assert MAX_DISTURBED >= 3


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_one_push_alone_proves_nothing_while_a_hand_drags_the_joint_one_way(direction):
    joint = Joint(hand=lambda now: 0.04 * direction if now > 0.4 else 0.0, friction=10.0)
    fault = joint.run(60.0)
    assert not joint.check.done
    assert fault is not None and fault.code in ("sign_unproven", "wrong_sign")
