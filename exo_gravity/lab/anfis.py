# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""ANFIS: an adaptive-network-based fuzzy inference system, first-order Takagi-Sugeno on a grid partition.

Jang, IEEE Transactions on Systems, Man, and Cybernetics 23 (1993) 665-685. Each of the d inputs has k membership
functions, here Gaussians: mu = exp(-((u - centre) / sigma)^2 / 2). Each of their k^d combinations is a rule. The firing
strength w of a rule is the product of its memberships, its consequent is f = p_0 + p_1 u_1 + ... + p_d u_d, and the
output is sum(w f) / sum(w). On a grid partition sum(w) is the product of one sum per input. The memberships of each
input can therefore be normalised separately, and the sum over the rules taken one input at a time.

`AnfisLaw` is a control law of such models. Outside the box of joint angles it was trained in, on a tilted trunk or with
another arm it would extrapolate with an unknown error: `outside` then returns the reason, and the caller uses the exact
law instead. An upright trunk needs no torque of joint 1. Gains c_n and gravity scale the torque as in every other law.
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from exo_gravity.core.arm.interface import MAX_GRAVITY
from exo_gravity.core.arm.paper import ArmModel
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.laws import ArmLaw, LawData
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.numbers import Torque, Vector, floats, one_float

MAX_RULES = 10_000  # 6 inputs of 4 functions give 4,096; more is probably a mistake, and would exhaust the memory
PARTS = ("centre", "sigma", "consequent")
INPUTS = ("theta_2", "theta_3", "theta_4")
JOINTS = ("2", "3", "4")
# Largest angle in rad between joint 1's axis and gravity of an upright trunk. A trunk tilt of 0.5 degrees changes
# the torques of the paper's arm by at most 0.04 Nm, a few steps of the motors' 12-bit torque.
UPRIGHT = math.radians(0.5)
FORMAT = "exo_gravity ANFIS law 1"


@dataclass(frozen=True, eq=False)
class Anfis:
    """m models with one output each, on the same d inputs, with k membership functions per input.

    Raises DataError unless the shapes agree and every number is finite.
    """

    centre: np.ndarray  #: premises, (m, d, k), in the inputs' units
    sigma: np.ndarray  #: premises, (m, d, k), > 0, in the inputs' units
    consequent: np.ndarray  #: (m, k^d, d + 1), p_0..p_d of each rule; the function of the last input varies fastest

    def __post_init__(self) -> None:
        try:
            parts = [np.array(getattr(self, name), dtype=float) for name in PARTS]
        except (TypeError, ValueError):
            parts = [np.empty(0)] * len(PARTS)
        models, inputs, functions = parts[0].shape if parts[0].ndim == 3 else (0, 0, 0)
        rules = functions**inputs
        expected = [(models, inputs, functions)] * 2 + [(models, rules, inputs + 1)]
        fits = [part.shape for part in parts] == expected and 0 < rules <= MAX_RULES
        if not (fits and all(np.all(np.isfinite(part)) for part in parts) and np.all(parts[1] > 0)):
            shapes = ", ".join(f"{name} {part.shape}" for name, part in zip(PARTS, parts, strict=True))
            bounds = (
                f"finite numbers, sigma > 0, of shapes (m, d, k), (m, d, k), (m, k^d, d + 1), k^d <= {MAX_RULES} rules"
            )
            raise DataError(f"ANFIS: {shapes}: must be {bounds}")
        for name, part in zip(PARTS, parts, strict=True):
            part.setflags(write=False)
            object.__setattr__(self, name, part)

    @property
    def rules(self) -> int:
        """Rules per model."""
        return int(self.consequent.shape[1])

    @property
    def parameters(self) -> int:
        """Parameters per model: premises and consequents."""
        return sum(getattr(self, part)[0].size for part in PARTS)

    def output(self, inputs: np.ndarray) -> np.ndarray:
        """Return the outputs (n, m) for inputs (n, d)."""
        value = inputs @ self.consequent[:, :, 1:].transpose(0, 2, 1) + self.consequent[:, None, :, 0]  # f, (m, n, k^d)
        share = grades(self.centre, self.sigma, inputs)
        models, count, dimension, functions = share.shape
        for axis in reversed(range(dimension)):
            value = (value.reshape(models, count, -1, functions) @ share[:, :, axis, :, None])[..., 0]
        return np.asarray(value[..., 0].T)


def grades(centre: np.ndarray, sigma: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Return the normalised memberships (m, n, d, k) of inputs (n, d); over k they sum to 1.

    centre, sigma: (m, d, k). Exponents are taken relative to the largest one, which avoids 0 / 0 far from all centres.
    """
    exponent = -0.5 * np.square((inputs[:, :, None] - centre[:, None]) / sigma[:, None])
    membership = np.exp(exponent - exponent.max(axis=-1, keepdims=True))
    return np.asarray(membership / membership.sum(axis=-1, keepdims=True))


@dataclass(frozen=True, eq=False)
class AnfisLaw:
    """Torques of an arm on an upright trunk, learned over a box of joint angles. Raises DataError, ParameterError."""

    #: one output in Nm for each of joints 2, 3 and 4 at gain 1; its inputs are theta_2..theta_4, -1..1 over the box
    model: Anfis
    low: tuple[float, ...]  #: lower corner of the box, (3,) rad
    high: tuple[float, ...]  #: upper corner
    first_moment: tuple[float, ...]  #: M2..M4 in kg m of the arm it was trained for
    gravity: float  #: m/s^2
    source: str  #: a sentence on the training data
    error: Mapping[str, Sequence[float]]  #: RMSE of joints 2 to 4: {'training': (3,) Nm, 'held_out': (3,) Nm}

    def __post_init__(self) -> None:
        inputs = self.model.centre.shape[1]
        if inputs != len(INPUTS):
            raise DataError(f"ANFIS file: {inputs} inputs: must be {len(INPUTS)}, {', '.join(INPUTS)}")
        for name, low, high in zip(INPUTS, self.low, self.high, strict=True):
            if not -2 * math.pi <= low < high <= 2 * math.pi:
                raise DataError(f"ANFIS file: box of {name} = {[low, high]}: must be [low, high] in rad")
        floats("first_moment", self.first_moment, len(JOINTS), 0.0, 1e3, "kg m")
        one_float("gravity", self.gravity, 0.1, MAX_GRAVITY, "m/s^2")

    @classmethod
    def load(cls, text: str) -> "AnfisLaw":
        """Return the law from JSON text. Raises DataError that names what is wrong."""
        try:
            content = json.loads(text)
            if content["format"] != FORMAT:
                raise DataError(f"ANFIS file: format = {content['format']!r}: must be {FORMAT!r}")
            joints = [content["joints"][joint] for joint in JOINTS]
            box = [tuple(float(bound) for bound in content["box"][name]) for name in INPUTS]
            low, high = zip(*box, strict=True)
            parts: Any = ([joint[part] for joint in joints] for part in PARTS)
            error = {kind: [float(joint[f"{kind}_rmse"]) for joint in joints] for kind in ("training", "held_out")}
            moment, gravity = tuple(map(float, content["arm"]["first_moment"])), float(content["arm"]["gravity"])
            return cls(Anfis(*parts), low, high, moment, gravity, str(content["source"]), error)
        except KeyError as error:
            raise DataError(f"ANFIS file: the key {error.args[0]} is missing") from None
        except (TypeError, ValueError, RecursionError) as error:
            raise DataError(f"ANFIS file: {error}: must be a file from train_anfis") from None

    def outside(self, arm: ArmModel, theta: Sequence[float], tilt: Tilt) -> str:
        """Return why the law was not trained for this arm, pose or tilt, in a sentence; '' if it was.

        The sentence contains no measured value, so it stays the same as long as the reason does.
        """
        if not tilt.axis_angle <= UPRIGHT:
            return f"the trunk is tilted by more than {math.degrees(UPRIGHT):g} degrees; the ANFIS was trained upright"
        for joint, angle, low, high in zip(JOINTS, theta[1:], self.low, self.high, strict=True):
            if not low <= angle <= high:
                return f"theta_{joint} is outside the ANFIS's training range, {low:.3f} to {high:.3f} rad"
        for joint, moment, trained in zip(JOINTS, arm.first_moment[1:], self.first_moment, strict=True):
            if not math.isclose(moment, trained, rel_tol=1e-6, abs_tol=1e-12):
                return f"the ANFIS was trained for another arm, whose M{joint} is {trained:.4f} kg m"
        return ""

    def torque(self, arm: ArmModel, theta: Sequence[float], tilt: Tilt) -> Torque:
        """Return the torque (4,) in Nm at pose `theta` (4,) rad; meaningless where `outside` gives a reason."""
        tau = self.torques(np.array((theta[1:],)))[0].tolist()
        felt, scale = tilt.magnitude / self.gravity, arm.scale
        return (0.0, *(felt * scale[joint] * value for joint, value in enumerate(tau, start=1)))

    def torques(self, theta: np.ndarray) -> np.ndarray:
        """Return the torques (n, 3) in Nm of joints 2 to 4 for their angles (n, 3) in rad, at gain 1."""
        return self.model.output(scaled(theta, self.low, self.high))


def scaled(theta: np.ndarray, low: Vector, high: Vector) -> np.ndarray:
    """Return angles (n, d) in rad, scaled to -1..1 over the box from `low` to `high` (d,)."""
    return np.asarray((2.0 * theta - low - high) / np.subtract(high, low))


def law(given: LawData) -> ArmLaw:
    """Return the law `anfis` of the model in `anfis_file`: an entry point of exo_gravity.laws.

    Raises ParameterError without a model, or for another arm than the paper's; DataError if the file has no such model.
    """
    if not given.trained:
        raise ParameterError("law", "anfis", "used with anfis_file, a model from train_anfis")
    trained = _loaded(given.trained)
    return ArmLaw(given.arm.with_masses("anfis"), trained.torque, trained.outside)


_loaded = lru_cache(2)(AnfisLaw.load)  # once for all changes of other settings


def text_of(law: AnfisLaw) -> str:
    """Return the JSON text that `AnfisLaw.load` reads, one line per rule."""
    joints = {}
    for i, joint in enumerate(JOINTS):
        joints[joint] = {f"{kind}_rmse": float(values[i]) for kind, values in law.error.items()}
        joints[joint] |= {part: getattr(law.model, part)[i].tolist() for part in PARTS}
    content = {
        "format": FORMAT,
        "about": "Takagi-Sugeno models (Jang 1993) of the holding torque in Nm of joints 2 to 4, trunk upright. "
        "Inputs: joint angles, scaled to -1..1 over the box (rad). Consequents: p_0..p_3 of each rule.",
        "source": law.source,
        "arm": {"first_moment": law.first_moment, "gravity": law.gravity},
        "box": dict(zip(INPUTS, zip(law.low, law.high, strict=True), strict=True)),
        "joints": joints,
    }
    return re.sub(r"\[[^\[\]]*\]", lambda found: " ".join(found[0].split()), json.dumps(content, indent=1)) + "\n"
