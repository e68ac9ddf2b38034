"""The last resort: lowers an arm without the state machine, after that one has failed and no watchdog can take over.

The torque fades slowly under full damping. The damping stays until the joints have been at rest for a while: a joint
under damping creeps, and would fall if it were switched off before it hangs. No exception ends this.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence

from exo_gravity.core.safety.drive import OFF, Drive
from exo_gravity.core.safety.limits import JointSample
from exo_gravity.hardware.can.motor_bus import MotorBus

FADE_TIME = 10.0  # s
DAMPING = 5.0  # Nm s/rad, the range of kd on the wire
REST_TIME = 10.0  # s
REST = 0.005  # rad that a joint may turn in that time
REPLY_TIMEOUT = 0.1  # s without a reply after which a motor's position is not known


def lower(bus: MotorBus, drive: Drive, period: float) -> None:
    """Lower an arm whose motors receive `drive`; return once every motor has replied to EXIT."""
    start = rest_since = time.monotonic()
    rest: Sequence[JointSample] = tuple(bus.samples)
    while (now := time.monotonic()) - rest_since < REST_TIME or now - start < FADE_TIME:
        share = max(0.0, 1.0 - (now - start) / FADE_TIME)
        effort = tuple(share * effort for effort in drive.effort)
        _exchange(bus, Drive(effort, (DAMPING,) * len(effort), True), now + period)
        if not all(_is_at_rest(now, joint, last) for joint, last in zip(bus.samples, rest, strict=True)):
            rest_since, rest = now, tuple(bus.samples)
    while bus.may_be_powered:
        _exchange(bus, OFF, time.monotonic() + period)


def _is_at_rest(now: float, joint: JointSample, last: JointSample) -> bool:
    return now - joint.time <= REPLY_TIMEOUT and abs(joint.position - last.position) <= REST


def _exchange(bus: MotorBus, drive: Drive, deadline: float) -> None:
    with contextlib.suppress(Exception):
        bus.exchange(drive, deadline)
    time.sleep(max(0.0, deadline - time.monotonic()))
