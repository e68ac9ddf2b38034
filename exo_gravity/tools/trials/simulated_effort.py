"""The wearer's effort on the simulated arm of a parameter file, without ROS: for `trial effort` and `validate`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from exo_gravity.core.effort import Effort
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.wearer import Wearer
from exo_gravity.sim.baselines import Burden, Feedforward, Law, burden
from exo_gravity.sim.device_params import SIMULATOR, device_of
from exo_gravity.sim.effort_study import IDENTIFIED, TASKS, WEARER_EXCESS, effort_settings, study
from exo_gravity.tools.inputs.arms import node_values, read_arm
from exo_gravity.tools.inputs.parameter_file import load, packaged_config


def effort_study(params: Path, body_mass: float) -> tuple[int, Iterator[tuple[str, str, Effort]]]:
    """Return the number of rows of the effort study on the first simulated arm of a parameter file, and its rows.

    body_mass: kg of the wearer if the file configures none. Raises ParameterError.
    """
    nodes = load(params)
    namespace = next((node.removesuffix("/simulator") for node in nodes if node.endswith("/simulator")), None)
    if namespace is None:
        raise ParameterError("params", str(params), "a file with a simulator: the effort is simulated")
    arm = read_arm(nodes, namespace)
    simulator = dict(node_values(nodes, f"{namespace}/simulator", SIMULATOR))
    base = arm.settings()
    if not any(base.wearer_mass):
        worn = Wearer(body_mass).on_links(base.robot.length)
        base = replace(base, wearer_mass=worn.mass.tolist(), wearer_cog=worn.cog.tolist())
    base = replace(base, use_imu=False, max_effort=[motor.peak_effort for motor in arm.motors])
    simulator["wearer.mass"] = [WEARER_EXCESS * mass for mass in base.wearer_mass]
    simulator["wearer.cog"] = list(base.wearer_cog)
    simulator["trunk.pitch"] = simulator["trunk.roll"] = 0.0
    friction = ([IDENTIFIED * value for value in simulator[f"friction.{part}"]] for part in ("coulomb", "viscous"))
    settings = effort_settings(base, *friction)
    return len(settings) * len(TASKS), study(lambda: device_of(simulator), arm.motors, settings)


def baseline_burden(law: Law | None, feedback: bool, pose_time: float) -> Burden:
    """Return what a controller costs the wearer on the packaged simulator; arguments: as in `Feedforward`."""
    nodes = load(packaged_config("sim.yaml"))
    simulator = {**node_values(nodes, "/right/simulator", SIMULATOR), "trunk.pitch": 0.0, "trunk.roll": 0.0}
    return burden(lambda: device_of(simulator), read_arm(nodes, "/right").motors, Feedforward(law, feedback, pose_time))
