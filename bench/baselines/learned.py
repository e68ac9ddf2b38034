# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Learned laws: their error, memory, time a pose, seconds to train, and what they cost the wearer.

The inputs are the four angles and the trunk's pitch and sideways tilt. Each baseline gets exact torques, without the
friction and noise of real ones, from a training box: `SHARE` of each joint's range, and tilts up to `TILT`. It is
judged inside that box and outside, up to the joints' limits and `FAR_TILT`.

The cube map is CyberForce's: torques at the vertices of a grid, interpolated. Outside the box it gives the
torque at the nearest edge.
"""

from __future__ import annotations

import math
import pickle
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from sklearn.ensemble import GradientBoostingRegressor
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.multioutput import MultiOutputRegressor
from sklearn.neural_network import MLPRegressor
from threadpoolctl import threadpool_limits

from exo_gravity.core.arm.gravity import exact_torque, gravity_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.lab.anfis_training import rms
from exo_gravity.lab.inputs.arms import ConfiguredArm, node_values, read_arm
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.lab.inputs.references import gravload
from exo_gravity.sim.params import SIMULATOR, device_of

from .controllers import Burden, Feedforward, Law, burden

SHARE = 0.7  # of each joint's range, in its middle
TILT, FAR_TILT = math.radians(10.0), math.radians(30.0)
SAMPLES = 3_000  # for training
GAUSSIAN_SAMPLES = 800  # of those: its cost grows with the cube
VERTICES = 5  # per input: 15,625 in all
HELD_OUT = 2_000  # positions, inside and outside each
TIMED = 200  # poses, one at a time
INPUTS = 6

Model = Callable[[np.ndarray], np.ndarray]  # inputs (n, 6) in -1..1 over the training box -> (n, 4) Nm


class Baseline(NamedTuple):
    """A law inside and outside the box where others were trained; NaN where there is no such figure."""

    law: str
    #: RMSE and largest error over all joints in Nm.
    inside_rmse: float = math.nan
    inside_largest: float = math.nan
    outside_rmse: float = math.nan
    outside_largest: float = math.nan
    #: Bytes.
    memory: float = math.nan
    #: s.
    pose_time: float = math.nan
    training_time: float = math.nan
    #: As in `Burden`.
    exertion: float = math.nan
    sag: float = math.nan
    sag_bowed: float = math.nan


class Workspace:
    """The torques of `configured`, by inputs scaled to -1..1 over the training box.

    held_out: inputs (n, 6) inside and outside the box, each with the torques (n, 4) by the Robotics Toolbox.
    """

    def __init__(self, configured: ConfiguredArm) -> None:
        self._configured = configured
        half = (configured.high - configured.low) / 2.0
        self.middle = np.append((configured.low + configured.high) / 2.0, (0.0, 0.0))
        self.half = np.append(SHARE * half, (TILT, TILT))
        self._edge = np.append(half, (FAR_TILT, FAR_TILT)) / self.half  # the whole workspace
        reference = gravload(configured.robot)
        chosen = self.inside(HELD_OUT, 1), self.outside(HELD_OUT, 2)
        self.held_out = [(inputs, reference(*self.poses(inputs))) for inputs in chosen]

    def poses(self, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the angles (n, 4) in rad and gravity's direction (n, 3)."""
        state = self.middle + inputs * self.half
        tilts = (Tilt.of(self._configured.side, pitch, roll) for pitch, roll in state[:, 4:].tolist())
        return state[:, :4], np.array([tilt.direction for tilt in tilts])

    def torque(self, inputs: np.ndarray) -> np.ndarray:
        """Return the torques (n, 4) in Nm by the exact law."""
        return gravity_torque(self._configured.robot, *self.poses(inputs))

    def law(self, model: Model) -> Law:
        """Return the model as a law of the angles (4,) and the trunk's pitch, in rad."""

        def torque(theta: Sequence[float], pitch: float) -> list[float]:
            inputs = (np.append(theta, (pitch, 0.0)) - self.middle) / self.half
            found: list[float] = model(inputs[None])[0].tolist()
            return found

        return torque

    def in_the_loop(self, inputs: np.ndarray) -> np.ndarray:
        """Return the torque (1, 4) of one pose, computed as the compensator does."""
        *theta, pitch, roll = (self.middle + inputs[0] * self.half).tolist()
        tilt = Tilt.of(self._configured.side, pitch, roll)
        return np.array([exact_torque(self._configured.robot, theta, tilt)])

    def inside(self, count: int, seed: int) -> np.ndarray:
        """Return `count` random inputs (n, 6) within the training box."""
        return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, INPUTS))

    def outside(self, count: int, seed: int) -> np.ndarray:
        """Return up to `count` random inputs (n, 6) of the workspace, of which at least one is beyond the box."""
        drawn = np.random.default_rng(seed).uniform(-self._edge, self._edge, (count, INPUTS))
        return drawn[np.abs(drawn).max(axis=1) > 1.0]


def baselines(configured: ConfiguredArm) -> Iterator[Baseline]:
    """Train each baseline, let it carry the simulated arm, and yield its figures; those without a law first."""
    workspace = Workspace(configured)
    inputs = workspace.inside(SAMPLES, 0)
    torque = workspace.torque(inputs)
    few = slice(GAUSSIAN_SAMPLES)
    exact = workspace.law(workspace.torque)
    yield _in_use("motors without torque", None, feedback=False)
    yield _in_use("joint PID", None, feedback=True)
    judged = _judged("exact law", workspace, lambda: (workspace.torque, configured.robot))
    yield judged._replace(pose_time=_pose_time(workspace.in_the_loop, inputs[:TIMED]))
    yield _in_use("exact law and PID", exact, feedback=True)
    yield _judged("cube map", workspace, lambda: cube_map(workspace))
    with threadpool_limits(1):
        yield _judged("neural network", workspace, lambda: _fitted(network(), inputs, torque))
        yield _judged("Gaussian process", workspace, lambda: _fitted(_gaussian_process(), inputs[few], torque[few]))
        yield _judged("gradient boosting", workspace, lambda: _fitted(_boosting(), inputs, torque))


def _in_use(name: str, law: Law | None, feedback: bool) -> Baseline:
    """Return the figures of a controller without a law, which has no model errors."""
    return Baseline(name, **baseline_burden(law, feedback, 0.0)._asdict())


def _judged(law: str, workspace: Workspace, train: Callable[[], tuple[Model, Any]]) -> Baseline:
    """Return the figures of the model that `train` returns, with what must be kept of it."""
    started = time.perf_counter()
    model, kept = train()
    seconds = time.perf_counter() - started
    pose_time = _pose_time(model, workspace.inside(TIMED, 3))
    in_use = baseline_burden(workspace.law(model), False, pose_time)._asdict()
    inside, outside = (model(inputs) - expected for inputs, expected in workspace.held_out)
    return Baseline(
        law,
        inside_rmse=float(rms(inside.ravel())),
        inside_largest=float(np.abs(inside).max()),
        outside_rmse=float(rms(outside.ravel())),
        outside_largest=float(np.abs(outside).max()),
        memory=len(pickle.dumps(kept)),
        pose_time=pose_time,
        training_time=seconds,
        **in_use,
    )


def baseline_burden(law: Law | None, feedback: bool, pose_time: float) -> Burden:
    """Return what a controller costs the wearer on the packaged simulator; arguments: as in `Feedforward`."""
    nodes = load(packaged_config("sim.yaml"))
    simulator = {**node_values(nodes, "/right/simulator", SIMULATOR), "trunk.pitch": 0.0, "trunk.roll": 0.0}
    return burden(lambda: device_of(simulator), read_arm(nodes, "/right").motors, Feedforward(law, feedback, pose_time))


def _pose_time(model: Model, inputs: np.ndarray) -> float:
    """Return the median time in s of one pose."""
    times = []
    for pose in inputs:
        started = time.perf_counter()
        model(pose[None])
        times.append(time.perf_counter() - started)
    return float(np.median(times))


def cube_map(workspace: Workspace) -> tuple[Model, Any]:
    """Return the cube map of a workspace, and what is kept of it."""
    axis = np.linspace(-1.0, 1.0, VERTICES)
    torque = workspace.torque(np.array(list(product(axis, repeat=INPUTS))))
    table = RegularGridInterpolator((axis,) * INPUTS, torque.reshape(*(VERTICES,) * INPUTS, 4))
    return lambda inputs: table(np.clip(inputs, -1.0, 1.0)), torque


def _fitted(regressor: Any, inputs: np.ndarray, torque: np.ndarray) -> tuple[Model, Any]:
    """Return a regressor of scikit-learn, trained on torques in units of their RMS."""
    scale = rms(torque)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # the iterations are limited, as for any user
        regressor.fit(inputs, torque / scale)
    return lambda given: scale * regressor.predict(given), regressor


def network() -> Any:
    """Return the neural network, untrained."""
    return MLPRegressor(
        hidden_layer_sizes=(64, 64), activation="tanh", solver="lbfgs", alpha=1e-6, max_iter=1500, random_state=0
    )


def _gaussian_process() -> Any:
    kernel = ConstantKernel(10.0, (1e-2, 1e5)) * RBF(np.full(INPUTS, 2.0), (0.1, 1e3)) + WhiteKernel(1e-6, (1e-10, 1.0))
    return GaussianProcessRegressor(kernel, random_state=0)


def _boosting() -> Any:
    one_joint = GradientBoostingRegressor(n_estimators=300, max_depth=5, subsample=0.5, random_state=0)
    return MultiOutputRegressor(one_joint)
