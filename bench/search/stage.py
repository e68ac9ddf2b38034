# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The arm of a case in virtual time, and what can happen to it beyond what exo_gravity/sim/events has."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from exo_gravity.core.arm.interface import Payload
from exo_gravity.sim import SimulatedDevice
from exo_gravity.sim.events import ACTS as SHARED
from exo_gravity.sim.events import imu_wrong, payload_dropped
from exo_gravity.sim.motors import simulated
from exo_gravity.sim.rig import IMU_PERIOD, Act, Rig

from ..arms import ARMS, Friction
from .case import BODY_MASS, CARRIED, Case

TILT_TIMEOUT = 0.08  # s, that of a real arm


class Stage(Rig):
    """The arm of `case`, hanging, with its motors off. played: the arm of config that it is."""

    def __init__(self, case: Case) -> None:
        self.played = ARMS[case.arm]
        configured = self.played.carried
        settings = replace(configured.settings, tilt_timeout=TILT_TIMEOUT, payload=Payload(case.payload))
        load = self.played.load_of(BODY_MASS) if self.played.worn else None
        worn = {"wearer_mass": load.mass.tolist(), "wearer_cog": load.cog.tolist()} if load else {}
        settings = replace(settings, mode="zero_g" if case.worn else "one_g", support=1.0, **worn)
        device_arm = self.played.device_arm(Friction(case.friction), load if case.worn else None)
        device_arm.carry(case.payload)
        device = SimulatedDevice(device_arm, [simulated(joint) for joint in configured.motors])
        limits = self.played.limits(case.rate)
        if case.begin == CARRIED:  # its signs are as good as proven, which takes 5 s
            limits = replace(limits, sign_check_torque=0.0)
        super().__init__(device, settings, configured.motors, limits, case.rate)
        self.clock.run(2.0 * IMU_PERIOD)


def body_mass(stage: Stage, mass: float) -> None:
    """Set the mass of the wearer's body, in kg, as the operator would."""
    load = stage.played.load_of(mass)
    stage.change(wearer_mass=load.mass.tolist(), wearer_cog=load.cog.tolist())


def lap(stage: Stage, duration: float) -> None:
    """Let the wearer lay their arm in their lap within `duration` s."""
    stage.act({"move": list(stage.played.lap), "over": duration})


def spasm(stage: Stage, size: float) -> None:
    """Shake the arm: eight pushes of 0.15 s, to and fro."""
    torque = [size * most for most in stage.played.spasm]
    stage.act(*({"push": [sign * each for each in torque], "over": 0.15} for sign in (1.0, -1.0) * 4))


def payload_flicked(stage: Stage) -> None:
    """Let the wearer throw upwards what they carry."""
    stage.act({"push": list(stage.played.flick), "over": 0.2})
    stage.clock.later(0.15, partial(payload_dropped, stage))


OWN: Mapping[str, Act] = {
    "support": SHARED["settings"],
    "body_mass": body_mass,
    "lap": lap,
    "spasm": spasm,
    "payload_flicked": payload_flicked,
    "imu_creeps": imu_wrong,
    "trunk_falls": SHARED["bow"],
}
ACTS: Mapping[str, Act] = {**SHARED, **OWN}
