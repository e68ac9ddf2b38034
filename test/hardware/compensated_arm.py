"""A simulated arm in virtual time, with a person's arm in it, that compensator and bridge carry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import JOINTS, Compensation, Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.wire_formats import MIT, WireFormat
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.drive import EffortCommand, State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.control_loop import ControlLoop
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.virtual_wearer import VirtualWearer

from ..support.simulated_device import joints_of, make_device
from .virtual_time import Wire

RATED, PEAK = (3.0, 9.0, 3.0, 3.0), (9.0, 18.0, 9.0, 9.0)  # Nm
CYCLE = 0.004  # s
POSE = (0.0, 0.4, 0.2, 0.5)  # rad, in which the rated torques carry the arm of 75 kg
START = 2.2  # s until the bridge carries the arm
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


class CompensatedArm:
    """The arm of a 75 kg wearer, carried in `pose`; settings: what differs from exact Zero-G.

    top_speed: rad/s, the largest true speed of a joint since the arm was raised. efforts: (n, 4) Nm, what the motors
    applied since then. is_damped: whether the bridge damps while the load changes.
    """

    def __init__(
        self,
        pose: Sequence[float] = POSE,
        limit: Sequence[float] = RATED,
        formats: Sequence[WireFormat] = (MIT,) * JOINT_COUNT,
        friction: float = 0.1,
        has_wearer: bool = True,
        cycle: float = CYCLE,
        **settings: Any,
    ) -> None:
        mass, cog = WEARER
        worn = {"wearer_mass": mass, "wearer_cog": cog} if has_wearer else {}
        self.settings = Settings(
            **{
                "side": "right",
                "robot": DEFAULT_LINKS,
                "mode": "zero_g",
                "wearer_mass": mass,
                "wearer_cog": cog,
                "max_effort": limit,
                "use_imu": False,
                **settings,
            }
        )
        self.is_damped = True
        self.compensator = Compensator(self.settings, JOINTS)
        self.answer = Compensation.withdrawn("")
        self.wire = Wire()
        self.clock = self.wire.clock
        motors = joints_of(formats)
        self.device = make_device(config=ArmConfig(coulomb_friction=(friction,) * 4, **worn), formats=formats)
        self.top_speed = 0.0
        self.torques: list[list[float]] = []
        self.wire.play(self.device, self._look)
        low, high = (-1.65, -0.17, -0.78, -0.17), (1.65, 3.14, 2.53, 3.14)
        limits = Limits(JOINTS, low, high, (5.0, 5.0, 5.0, 6.0), limit, sign_check_torque=0.0)
        bus = MotorBus(self.wire.open(), motors, reopen=self.wire.open, clock=self.clock)
        self.safety = SafetyMachine(limits, cycle, motors)
        self.loop = ControlLoop(bus, self.safety, cycle, get_efforts=self._get_efforts)
        self.person = Person(pose)
        self.device.start(self.person, START)
        self.safety.enable(self.clock.monotonic())
        self.run(START + MOVE + 0.5)
        assert self.safety.state is State.ACTIVE, (self.safety.fault, self.safety.waiting_for)
        self.top_speed = 0.0
        self.torques.clear()

    def _look(self) -> None:
        self.top_speed = max(self.top_speed, *map(abs, self.device.arm.velocities))

    def _get_efforts(self, _latest: float) -> EffortCommand:
        samples = self.loop.samples
        theta, velocity = [s.position for s in samples], [s.velocity for s in samples]
        self.answer = self.compensator.step(self.clock.monotonic(), theta, velocity)
        damped = self.answer.damped and self.is_damped
        return EffortCommand(self.answer.effort, min(s.time for s in samples), damped)

    def change(self, **settings: Any) -> None:
        """Change the compensator's settings live."""
        self.settings = replace(self.settings, **settings)
        self.compensator.apply(self.settings)

    def run(self, duration: float) -> None:
        """Let `duration` s pass."""
        end = self.clock.monotonic() + duration
        while self.clock.monotonic() < end:
            self.loop.cycle()
            arm = self.device.arm
            torque = [m.torque(p, v) for m, p, v in zip(self.device.motors, arm.positions, arm.velocities, strict=True)]
            self.torques.append(torque)
