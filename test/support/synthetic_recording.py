"""Recordings with known holds, drifts, pushes and let-downs, as motors would measure them."""

from __future__ import annotations

import numpy as np

from exo_gravity.lab.trial.recording import Recording, ScriptedStep

RATE = 500.0  # Hz
POSITION_CODE = 25.0 / 65535  # rad
VELOCITY_CODE = 90.0 / 4095  # rad/s
POSE_A = np.array([0.1, 0.4, 0.5, 0.6])
POSE_B = np.array([-0.3, 0.9, 1.2, 0.2])
HANGING = np.array([0.0, 0.05, 0.0, 0.1])
SCRIPT = (ScriptedStep("move", 0.0, 2.0), ScriptedStep("hold", 2.0, 12.0))
STOPPED_IN_A_HOLD = (ScriptedStep("move", 5.0, 7.0), ScriptedStep("hold", 7.0, 60.0))


def smooth(begin: np.ndarray, end: np.ndarray, seconds: float) -> np.ndarray:
    """Return a minimum-jerk motion, (n, 4)."""
    s = np.arange(round(seconds * RATE))[:, None] / (seconds * RATE)
    return begin + (end - begin) * (10 * s**3 - 15 * s**4 + 6 * s**5)


def still(pose: np.ndarray, seconds: float, drift: float | np.ndarray = 0.0) -> np.ndarray:
    """Return a pose that drifts by `drift` (rad/s, one number or one per joint), (n, 4)."""
    return pose + np.arange(round(seconds * RATE))[:, None] / RATE * drift


def recording(
    *pieces: np.ndarray,
    steps: tuple[ScriptedStep, ...] = (),
    noise: float = 0.0,
    effort: np.ndarray | None = None,
    command: np.ndarray | None = None,
    carried: tuple[tuple[float, float], ...] | None = None,
) -> Recording:
    """Return the readings of motors that move through `pieces` of position: quantised, with no velocity of 0."""
    exact = np.concatenate(pieces)
    rng = np.random.default_rng(1)
    time = np.arange(len(exact)) / RATE
    position = np.round((exact + noise * rng.standard_normal(exact.shape)) / POSITION_CODE) * POSITION_CODE
    velocity = np.gradient(exact, 1 / RATE, axis=0)
    velocity = (np.round(velocity / VELOCITY_CODE - 0.5) + 0.5) * VELOCITY_CODE
    effort = np.ones_like(exact) if effort is None else effort
    command = effort if command is None else command
    names = ("j1", "j2", "j3", "j4")
    return Recording(
        "right", names, time, position.astype(np.float32), velocity, effort, command, tuple(steps), carried
    )


def two_poses() -> Recording:
    """Return a recording with holds from 0 to 10 s and from 12 to 22 s."""
    return recording(still(POSE_A, 10.0), smooth(POSE_A, POSE_B, 2.0), still(POSE_B, 10.0))


def released(pose_at_end: np.ndarray, seconds: float = 1.0) -> Recording:
    """Move to `POSE_A`, release at 2 s, then drift to another pose."""
    return recording(
        smooth(POSE_B, POSE_A, 2.0),
        smooth(POSE_A, pose_at_end, seconds),
        still(pose_at_end, 10.0 - seconds),
        steps=SCRIPT,
    )


def carried_until(end: float, steps: tuple[ScriptedStep, ...] = ()) -> Recording:
    """Hang for 5 s, lift to `POSE_A` in 2 s, hold for 10 s, and let down from 17 s to 21 s."""
    pieces = (
        still(HANGING, 5.0),
        smooth(HANGING, POSE_A, 2.0),
        still(POSE_A, 10.0),
        smooth(POSE_A, HANGING, 4.0),
        still(HANGING, 5.0),
    )
    return recording(*pieces, steps=steps, carried=((4.0, end),))
