"""Whether motors that may have lost their power, or may be on unasked, apply torque: what may be sent to them.

All motors silent at once means that their supply was cut, as by an emergency stop, or that the bus was. A motor that
restarted is off, and must stay off until the operator enables the arm; one that kept its power still applies its last
command, and must be let down. Only its replies tell. Until then a motor is `unsure`: it is sent nothing that could
switch it on (`MotorBus`). The same holds for the motors of an owner that left no notes.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence

from exo_gravity.core.safety.drive import NOTHING
from exo_gravity.core.safety.limits import JointSample

# A motor that is off may report 0.15 Nm of noise (standard deviation); smoothed at 100 Hz that is 0.05 Nm, so one read
# in ten thousand takes such a motor for one that is on. Less than SHOWN cannot throw an arm when it is switched off.
SHOWN = 0.2  # Nm of smoothed torque that shows a motor on
SMOOTHING = 0.05  # s, time constant
READ_TIME = 0.2  # s of replies without torque that show motors off; an arm that sinks under damping shows torque sooner


class SupplyMonitor:
    """Reads from the replies which motors are on. unsure: (4,) those of which it is not known."""

    def __init__(self) -> None:
        self._times = list(NOTHING)  # s, of each motor's last reply
        self.doubt(NOTHING)
        self.settle()

    @property
    def returning(self) -> tuple[bool, ...]:
        """Those (4,) in doubt that were silent: they may apply another torque than the last one sent."""
        return tuple(map(operator.and_, self.unsure, self._were_silent))

    @property
    def are_off(self) -> bool:
        """Whether every motor in doubt has replied for READ_TIME without torque."""
        doubtful = [heard for heard, is_unsure in zip(self._heard, self.unsure, strict=True) if is_unsure]
        return bool(doubtful) and min(doubtful) >= READ_TIME

    def doubt(self, held: Sequence[float]) -> None:
        """Doubt every motor; they apply `held` (4,) Nm if they are on."""
        self._held = held
        self.unsure: tuple[bool, ...] = (True,) * len(held)
        self._torque = list(NOTHING)  # smoothed, since the motor replies again
        self._heard = list(NOTHING)  # s for which it has replied again
        self._were_silent = [False] * len(held)

    def settle(self, silent: Sequence[bool] = (False,) * len(NOTHING)) -> None:
        """End all doubt, apart from that of motors that are `silent` (4,)."""
        self.unsure = tuple(is_unsure and is_silent for is_unsure, is_silent in zip(self.unsure, silent, strict=True))

    def step(self, dt: float, joints: Sequence[JointSample], silent: Sequence[bool]) -> bool:
        """Take the newest readings; return whether one shows that its motor is on. silent: (4,) who does not reply."""
        if not any(self.unsure):
            return False
        for i, joint in enumerate(joints):
            self._heard[i] = 0.0 if silent[i] else self._heard[i] + dt
            if silent[i]:
                self._torque[i], self._were_silent[i] = 0.0, True
            elif joint.time > self._times[i]:
                self._torque[i] += min(1.0, dt / SMOOTHING) * (joint.effort - self._torque[i])
                self._times[i] = joint.time
        shown = [abs(torque) > SHOWN for torque in self._torque]
        if not any(shown):
            return False
        # The motors of an arm share a supply: one that has too little to hold for its replies to tell is on, too.
        self.unsure = tuple(
            is_unsure and not is_shown and (is_silent or abs(held) > 2.0 * SHOWN)
            for is_unsure, is_shown, is_silent, held in zip(self.unsure, shown, silent, self._held, strict=True)
        )
        return True
