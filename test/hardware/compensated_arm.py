# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A simulated arm in virtual time, with a person's arm in it, that compensator and bridge carry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import JOINTS, Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.frames import WireFormat
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.drive import Efforts, State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.controllers import DirectController
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.virtual_arm import TrunkSensor, VirtualArm
from exo_gravity.sim.virtual_wearer import VirtualWearer

from ..support.copies import prepared
from ..support.simulated_device import joints_of, make_device

RATED, PEAK = (3.0, 9.0, 3.0, 3.0), (9.0, 18.0, 9.0, 9.0)  # Nm
CYCLE = 0.004  # s
POSE = (0.0, 0.4, 0.2, 0.5)  # rad, in which the rated torques carry the arm of 75 kg
MOVE = 2.0  # s in which a hand brings the arm to its pose
WEARER = Wearer(75.0).on_links(DEFAULT_LINKS.length)
Hand = Callable[[float, Sequence[float], Sequence[float]], Sequence[float]]  # s, angles, velocities -> (4,) Nm


class Person(VirtualWearer):
    """Brings the arm to a pose, lets go, and then applies the torque of `hand`, if there is one."""

    def __init__(self, pose: Sequence[float]) -> None:
        super().__init__(TrialScript.parse({"name": "raise", "steps": [{"move": list(pose), "over": MOVE}]}))
        self.hand: Hand | None = None

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> tuple[float, ...]:
        return tuple(self.hand(elapsed, theta, velocity)) if self.hand else super().torque(elapsed, theta, velocity)

    def idle(self, elapsed: float, duration: float) -> bool:
        return self.hand is None and super().idle(elapsed, duration)


class CompensatedArm(DirectController, VirtualArm):
    """The arm of a 75 kg wearer, carried in `pose`; settings: what differs from exact Zero-G.

    imu: of the trunk; None for a trunk that is upright.
    rate: cycles of the loop per s.

    top_speed: rad/s, the largest true speed of a joint since the arm was raised. driven: rad/s, the same of a joint
    along its motor's torque. torques: (n, 4) Nm, what the motors applied since then. is_damped: whether the bridge
    damps while the load changes.
    """

    def __init__(
        self,
        pose: Sequence[float] = POSE,
        limit: Sequence[float] = RATED,
        formats: Sequence[WireFormat] = (MIT,) * JOINT_COUNT,
        friction: float = 0.1,
        has_wearer: bool = True,
        imu: TrunkSensor | None = None,
        rate: float = 1.0 / CYCLE,
        **settings: Any,
    ) -> None:
        mass, cog = WEARER
        worn = {"wearer_mass": mass, "wearer_cog": cog}
        given = {"mode": "zero_g", "support": 1.0, "max_effort": limit, "use_imu": bool(imu), **worn, **settings}
        self.settings = Settings("right", DEFAULT_LINKS, **given)
        self.is_damped = True
        self.top_speed = self.driven = 0.0
        self.torques: list[list[float]] = []
        limits = Limits(JOINTS, max_effort=limit, sign_check_torque=0.0)
        config = ArmConfig(coulomb_friction=(friction,) * JOINT_COUNT, **(worn if has_wearer else {}))
        device = make_device(config=config, formats=formats)
        DirectController.__init__(self, Compensator(self.settings, JOINTS), limits)
        VirtualArm.__init__(self, device, self, joints_of(formats), limits, rate, look=self._look)
        self.person = Person(pose)
        if imu:
            self.add_imu(imu, self.compensator, 0.01)
        self.enable()
        assert self.run_until(lambda: self.safety.state is State.ACTIVE), (self.safety.fault, self.safety.waiting_for)
        device.start(self.person)
        self.run(MOVE + 0.5)
        assert self.safety.state is State.ACTIVE, self.safety.fault
        self.forget()

    def forget(self) -> None:
        """Forget how fast the joints were and what the motors applied."""
        self.top_speed = self.driven = 0.0
        self.torques.clear()

    def efforts(self, latest: float) -> Efforts:
        """Return the compensator's newest efforts."""
        efforts = super().efforts(latest)
        return efforts if self.is_damped else efforts._replace(damped=False)

    def _look(self) -> None:
        arm = self.device.arm
        position, velocity = arm.positions, arm.velocities
        self.top_speed = max(self.top_speed, *map(abs, velocity))
        joints = zip(self.device.motors, position, velocity, strict=True)
        self.torques.append([motor.torque(angle, speed) for motor, angle, speed in joints])
        along = (abs(speed) for speed, torque in zip(velocity, self.torques[-1], strict=True) if speed * torque > 0.0)
        self.driven = max([self.driven, *along])

    def change(self, **settings: Any) -> None:
        """Change the compensator's settings live."""
        self.settings = replace(self.settings, **settings)
        self.compensator.apply(self.settings)


compensated_arm = prepared(CompensatedArm)
