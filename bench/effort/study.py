# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What is compared: the settings of the compensator, the simulated arm with a wearer in it, and a weak wearer's reach.

The wearer's passive arm is `WEARER_EXCESS` heavier than configured. Motors may give their peak torque: the arm of a
wearer of 75 kg is beyond what they are rated for. The terms know ninety per cent of the joints' friction.

Freebal's measure is the workspace that a weak arm reaches. A weak wearer has only a share of the torque that the
outstretched arm requires. They move the arm from a low pose straight to each pose of a grid, and reach it if on the
whole way, on every joint, their strength exceeds what compensation leaves of the weight, plus friction. The motion is
slow: inertia is left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from exo_gravity.core.arm.arm import ArmModel, papers
from exo_gravity.core.arm.gravity import gravity_torque
from exo_gravity.core.arm.kinematics import least_inertia, links_of
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.terms.catalogue import (
    DELAY,
    Coupling,
    Damping,
    Friction,
    Inertia,
    SoftLimits,
    Spring,
)
from exo_gravity.core.compensation.terms.terms import TermSettings
from exo_gravity.lab.inputs.arms import ConfiguredArm, node_values, read_arm
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.params import SIMULATOR, device_of

from .exertion import MIDDLE, REACH, TASKS, Exertion, measure

BODY_MASS = 75.0  # kg
WEARER_EXCESS = 1.03
IDENTIFIED = 0.9  # share of the friction that `calibrate` found
SOFT = 0.9  # share of the stiffness and viscosity that this arm can bear
NOTHING, ONE_G, ZERO_G, BOTH = "nothing", "One-G", "Zero-G 100 %", "+ friction and inertia"
QUICK = (NOTHING, ONE_G, ZERO_G, BOTH)

STRENGTHS = (0.25, 0.35, 0.5)  # of the torque that the wearer's own arm requires, outstretched
LEAST = 1.0  # Nm of any joint: in most poses shoulder rotation carries little
LOW = (0.0, 0.2, 0.0, 0.2)  # rad, where the weak wearer begins
GRID = (13, 9, 9)  # positions of joints 2, 3, 4: 1,053, as many as in the paper
POINTS = 10  # of each way


def settings_by_name(base: Settings, coulomb: Sequence[float], viscous: Sequence[float]) -> dict[str, Settings | None]:
    """Return the settings that are compared; None: the motors are on without torque.

    base: of the arm and its wearer. coulomb Nm, viscous Nm s/rad: the friction that the terms know, (4,) each.
    """
    known = Friction(coulomb=coulomb, viscous=viscous)
    least = least_inertia(links_of(papers(base.robot_by_mass or base.loaded)))
    soft = [min(20.0, SOFT * inertia / (4.0 * DELAY**2)) for inertia in least]  # Nm/rad
    terms = {
        "friction": TermSettings(friction=replace(known, share=0.4)),
        "inertia": TermSettings(friction=known, inertia=Inertia(0.7)),
        "friction and inertia": TermSettings(friction=replace(known, share=0.4), inertia=Inertia(0.7)),
        "damping": TermSettings(damping=Damping([SOFT * inertia / (2.0 * DELAY) for inertia in least])),
        "spring": TermSettings(spring=Spring(soft, MIDDLE)),
        "coupling": TermSettings(coupling=Coupling((0.0, 0.0, -0.4 * min(soft), 0.5 * min(soft)))),
        "limits": TermSettings(limits=SoftLimits((-0.5, 0.3, 0.0, 0.2), (1.5, 1.6, 1.6, 2.5), soft)),
    }
    zero = replace(base, mode="zero_g", support=1.0)
    return {
        NOTHING: None,
        ONE_G: replace(base, mode="one_g"),
        **{f"Zero-G {share} %": replace(zero, support=share / 100.0) for share in (0, 25, 50, 75, 100)},
        **{f"+ {name}": replace(zero, terms=chosen) for name, chosen in terms.items()},
    }


@dataclass(frozen=True)
class Study:
    """One simulated arm with a wearer in it, and the settings that are compared on it."""

    arm: ConfiguredArm
    #: Parameter values of the simulator.
    simulator: Mapping[str, Any]
    settings: dict[str, Settings | None]

    @classmethod
    def of(cls, params: Path | None = None) -> Study:
        """Return the study of the right arm of a parameter file, by default the packaged simulator's."""
        nodes = load(params or packaged_config("sim.yaml"))
        arm = read_arm(nodes, "/right")
        base = arm.settings()
        worn = Wearer(BODY_MASS).on_links(papers(base.loaded).length)
        base = replace(base, wearer_mass=worn.mass.tolist(), wearer_cog=worn.cog.tolist())
        base = replace(base, use_imu=False, max_effort=[motor.peak_effort for motor in arm.motors])
        simulator = dict(node_values(nodes, "/right/simulator", SIMULATOR))
        simulator["wearer.mass"] = [WEARER_EXCESS * mass for mass in base.wearer_mass]
        simulator["wearer.cog"] = list(base.wearer_cog)
        simulator["trunk.pitch"] = simulator["trunk.roll"] = 0.0
        friction = ([IDENTIFIED * value for value in simulator[f"friction.{part}"]] for part in ("coulomb", "viscous"))
        return cls(arm, simulator, settings_by_name(base, *friction))

    def parts(self, quick: bool, rate: float, params: Path | None) -> list[TaskUnderSetting]:
        """Return what is played: each task under each setting; quick: a reach under the settings `QUICK`."""
        settings, tasks = (QUICK, (REACH,)) if quick else (self.settings, TASKS)
        return [TaskUnderSetting(name, task.name, rate, params) for name in settings for task in tasks]

    def workspaces(self) -> Iterator[tuple[str, float, float]]:
        """Yield setting, strength of a weak wearer as a share, and the share of the workspace that they reach."""
        bounds = zip(self.arm.low[1:], self.arm.high[1:], GRID, strict=True)
        grid = np.array(list(product((0.0,), *(np.linspace(low, high, count) for low, high, count in bounds))))
        config, wearer = device_of(self.simulator).arm.config, self.settings[ONE_G]
        assert wearer is not None
        assert isinstance(config, ArmConfig)
        own = ArmModel(papers(wearer.loaded).length, wearer.wearer_cog, wearer.wearer_mass)
        most = np.abs(gravity_torque(own, grid)).max(axis=0)
        true = config.links.with_wearer(config.wearer_mass, config.wearer_cog)
        for name, settings in self.settings.items():
            if name.startswith("+"):
                continue
            needed = np.zeros(grid.shape)
            for share in np.linspace(0.0, 1.0, POINTS):
                poses = LOW + share * (grid - LOW)
                left = gravity_torque(true, poses)
                if settings:
                    limit = np.array(settings.max_effort)
                    left -= np.clip(gravity_torque(papers(settings.arm), poses), -limit, limit)
                needed = np.maximum(needed, np.abs(left) + config.coulomb_friction)
            for strength in STRENGTHS:
                reached = np.all(needed <= np.maximum(LEAST, strength * most), axis=1)
                yield name, strength, float(reached.mean())


class TaskUnderSetting(NamedTuple):
    """A task under a setting. rate: of the control loop, Hz. params: as `Study.of` takes it."""

    setting: str
    task: str
    rate: float
    params: Path | None


def played(part: TaskUnderSetting) -> tuple[TaskUnderSetting, Exertion]:
    """Play a part on a new device."""
    study = Study.of(part.params)
    task = next(task for task in TASKS if task.name == part.task)
    device, settings = device_of(study.simulator), study.settings[part.setting]
    return part, measure(device, study.arm.motors, settings, task, part.rate)
