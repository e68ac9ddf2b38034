"""The arm of a parameter file, and the workspace it moves in: what `validate` and `train_anfis` work on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from exo_gravity.core.arm import ArmModel, four_floats
from exo_gravity.core.errors import ParameterError
from exo_gravity.tools.budget import DEFAULTS, NAMES
from exo_gravity.tools.inputs.parameter_file import load, packaged_config


@dataclass(frozen=True, eq=False)
class ConfiguredArm:
    """The robot's own arm, without a wearer (One-G), its side, its joints' names and limits low and high, (4,) rad."""

    arm: ArmModel
    side: str
    joint_names: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray


def configured_arm(params: str | Path | None = None, side: str = "right") -> ConfiguredArm:
    """Return the workspace of the `side` arm of a parameter file, by default the packaged exo.yaml.

    Raises ParameterError that names the file or the parameter.
    """
    path = Path(params) if params else packaged_config("exo.yaml")
    nodes = load(path)
    compensators = {node: values for node, values in nodes.items() if node.endswith("/compensator")}
    found = [node for node, values in compensators.items() if values.get("side", "right") == side]
    if len(found) != 1:
        raise ParameterError("params", str(path), f"a file with one compensator whose side is {side}, not {len(found)}")
    namespace = found[0].removesuffix("/compensator")
    value = {**DEFAULTS, **nodes.get(f"{namespace}/can_bridge", {}), **nodes[found[0]]}
    try:
        arm = ArmModel(*(value[key] for key in ("link_length", "robot.cog", "robot.mass", "gain", "gravity")))
        low, high = (four_floats(key, value[key], -math.pi, math.pi, "rad") for key in ("position_min", "position_max"))
        if not np.all(low < high):
            raise ParameterError("position_min", low, f"below position_max = {high.tolist()} rad")
    except ParameterError as error:
        raise ParameterError(f"{namespace} {NAMES.get(error.name, error.name)}", error.value, error.expected) from None
    return ConfiguredArm(arm, side, tuple(map(str, value.get("joint_names", ()))), low, high)


def with_cog_at_link_ends(arm: ArmModel) -> ArmModel:
    """Return the arm as the paper's equations have it: d_n = l_n, c_n = 1 and g = 9.8 m/s^2."""
    return ArmModel(arm.length, arm.length, arm.mass, gravity=9.8)
