"""The wearer's effort on the simulated arm of a parameter file: for `trial effort` and `validate`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.terms.settings import GROUPS
from exo_gravity.core.effort import Effort
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.wearer import Wearer
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.params import params_of
from exo_gravity.core.trial.script import TrialScript
from exo_gravity.sim.baselines import Burden, Feedforward, Law, burden
from exo_gravity.sim.device_params import SIMULATOR, device_of
from exo_gravity.sim.effort import Sweep, Task
from exo_gravity.sim.effort_script import effort_script, efforts_of_truth
from exo_gravity.sim.effort_study import IDENTIFIED, RATE, REACH, TASKS, WEARER_EXCESS, effort_settings, study
from exo_gravity.sim.weak_wearer import STRENGTHS, grid_of, reached_share, weak_strength
from exo_gravity.tools.inputs.arms import node_values, read_arm
from exo_gravity.tools.inputs.parameter_file import Nodes, load, packaged_config

QUICK_SETTINGS = ("nothing", "One-G", "Zero-G 100 %", "+ friction and inertia")
START_DELAY = 2.0  # s from the motors being on to the wearer's first step


@dataclass(frozen=True)
class EffortStudy:
    """One simulated arm with a wearer in it, and what is compared on it.

    nodes: of the parameter file. simulator: its values. settings: of the compensator by name, None for motors without
    torque. supports: those without terms, for the workspace of a weak arm.
    """

    namespace: str
    nodes: Nodes
    simulator: Mapping[str, Any]
    motors: tuple[JointMotor, ...]
    settings: dict[str, Settings | None]
    supports: dict[str, Settings | None]
    tasks: tuple[Task | Sweep, ...]

    @classmethod
    def of(cls, params: Path, body_mass: float, quick: bool) -> EffortStudy:
        """Return the study of the first simulated arm of a parameter file; quick: a reach under `QUICK_SETTINGS`.

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
        supports = {name: value for name, value in settings.items() if not name.startswith("+")}
        if quick:
            settings = {name: settings[name] for name in QUICK_SETTINGS}
        return cls(namespace, nodes, simulator, arm.motors, settings, supports, (REACH,) if quick else TASKS)

    def offline(self) -> tuple[int, Iterator[tuple[str, str, Effort]]]:
        """Return the number of rows, and setting, task and effort of each, without nodes."""
        count = len(self.settings) * len(self.tasks)
        return count, study(lambda: device_of(self.simulator), self.motors, self.settings, self.tasks)

    def workspaces(self) -> Iterator[tuple[str, float, float]]:
        """Yield setting, strength of a weak wearer as a share, and the share of the workspace that he reaches."""
        arm = read_arm(self.nodes, self.namespace)
        grid, config = grid_of(arm.low.tolist(), arm.high.tolist()), device_of(self.simulator).arm.config
        wearer = self.supports["One-G"]
        assert wearer is not None
        for name, settings in self.supports.items():
            for share in STRENGTHS:
                yield name, share, reached_share(config, settings, weak_strength(wearer, grid, share), grid)

    @property
    def script(self) -> dict[str, Any]:
        """The script of one setting on nodes, as in a trial's YAML file."""
        return effort_script(self.tasks)

    def parameters(self, setting: str, truth: Path) -> dict[str, dict[str, Any]]:
        """Return the nodes' parameters for a run with `setting`; truth: file for the simulator's log."""
        bridge, compensator, simulator = (
            {**self.nodes[f"{self.namespace}/{node}"]} for node in ("can_bridge", "compensator", "simulator")
        )
        # The duration of the sign check varies, and a wearer's arm would make it longer. The rate is as offline.
        bridge.update(max_effort=[motor.peak_effort for motor in self.motors], sign_check_torque=0.0, rate=RATE)
        compensator.update(_values_of(self.settings[setting]))
        simulator.update({name: self.simulator[name] for name in ("wearer.mass", "wearer.cog")})
        simulator.update({"trunk.pitch": 0.0, "trunk.roll": 0.0, "imu.topic": ""})
        simulator.update({"trial_delay": START_DELAY, "truth": str(truth)})
        named = {"can_bridge": bridge, "compensator": compensator, "simulator": simulator}
        return {f"{self.namespace}/{node}": {"ros__parameters": values} for node, values in named.items()}

    def efforts(self, truth: Path) -> dict[str, Effort]:
        """Return the effort of each task that the log `truth` holds from start to end."""
        return efforts_of_truth(truth, TrialScript.parse(self.script))


def _values_of(settings: Settings | None) -> dict[str, Any]:
    """Return the parameters of `compensator` for `settings`; None: no torque."""
    if settings is None:
        return {"use_imu": False, "gain": [0.0] * 4}
    values: dict[str, Any] = {name: getattr(settings, name) for name in ("mode", "support", "use_imu", "max_effort")}
    values.update({"wearer.mass": settings.wearer_mass, "wearer.cog": settings.wearer_cog})
    for prefix, owner in GROUPS.items():
        group = getattr(settings.terms, prefix)
        values.update({f"{prefix}.{param.name}": getattr(group, param.name) for param in params_of(owner)})
    return {name: value if isinstance(value, str | bool | float) else list(value) for name, value in values.items()}


def baseline_burden(law: Law | None, feedback: bool, pose_time: float) -> Burden:
    """Return what a controller costs the wearer on the packaged simulator; arguments: as in `Feedforward`."""
    nodes = load(packaged_config("sim.yaml"))
    simulator = {**node_values(nodes, "/right/simulator", SIMULATOR), "trunk.pitch": 0.0, "trunk.roll": 0.0}
    return burden(lambda: device_of(simulator), read_arm(nodes, "/right").motors, Feedforward(law, feedback, pose_time))
