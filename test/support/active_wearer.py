# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A wearer who acts on the simulated arm. `attach` lets them act.

A behaviour is a function of the time in s since it began and of the arm's true angles and velocities, (n,) rad and
rad/s; it returns the wearer's torque (n,) in Nm on the joints.
"""

from collections.abc import Callable, Sequence

from exo_gravity.core.numbers import NO_TORQUE
from exo_gravity.sim import SimulatedDevice
from exo_gravity.sim.device import VirtualWearer
from exo_gravity.sim.script import Step, TrialScript

Joints = Sequence[float]
Behaviour = Callable[[float, Joints, Joints], Joints]

ANY = TrialScript("active wearer", (Step("hold", 3600.0),))


class ActiveWearer(VirtualWearer):
    """Behaves as `behaviour` says, for as long as the device runs."""

    def __init__(self, behaviour: Behaviour) -> None:
        super().__init__(ANY)
        self._behaviour = behaviour

    def torque(self, elapsed: float, theta: Joints, velocity: Joints) -> tuple[float, ...]:
        return tuple(self._behaviour(elapsed, theta, velocity)) if elapsed >= 0.0 else NO_TORQUE


def attach(device: SimulatedDevice, behaviour: Behaviour, delay: float = 0.0) -> None:
    """Let a wearer act on the arm of `device` in `delay` s, in place of any other."""
    device.start(ActiveWearer(behaviour), delay)
