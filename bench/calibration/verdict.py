# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The limits of the study, and the table of its results."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..device_study import Row
from .way import Result

NEAR = 0.02  # of the largest moment, by which a moment may be off
DEVIATIONS = 2.0  # standard errors, by which it may be off instead
COVERAGE = (0.90, 0.99)  # of +- DEVIATIONS standard errors
HELD_OUT = 0.02  # of the peak torque
MAX_POSES, MAX_MINUTES = 12, 4.0
BEFORE, AFTER = 5.0, 0.2  # deg/min


def verdict(results: Sequence[Result], failed: Sequence[str]) -> list[Row]:
    """Return the rows for the devices that finished; failed: sentences on those that did not."""
    count = len(results) + len(failed)
    rows = [Row("devices calibrated", f"{len(results)} of {count}", "all", not failed)]
    return rows + (_motors(results) + _moments(results) + _torques(results) + _holding(results) if results else [])


def _motors(results: Sequence[Result]) -> list[Row]:
    count = len(results)
    right = np.array([result.motors_right for result in results]).sum(axis=0)
    zero, hanging = (np.abs([getattr(result, name) for result in results]) for name in ("zero_error", "hanging_error"))
    imu = np.array([result.imu_error for result in results])
    detected = sum(result.turns_told for result in results)
    names = ("IDs right", "directions right", f"zeros right from the jig (worst {zero.max():.2f} deg)")
    rows = [
        Row(f"motors: {name}", f"{part} of {count}", "all", part == count)
        for name, part in zip(names, right, strict=True)
    ]
    largest = " ".join(f"{value:.1f}" for value in hanging.max(axis=0))
    free = Row("motors: zero error if the arm hangs, worst of each joint", f"{largest} deg", "", True)
    turns = Row("motors: rotor turns after power-up detected", f"{detected} of {count}", "all", detected == count)
    typical, worst = np.median(imu, axis=0), imu.max(axis=0)
    mounting = [
        Row(f"imu: mounting error {when}, median", f"{typical[i]:.1f} deg, worst {worst[i]:.1f}", "", True)
        for i, when in enumerate(("from three bows", "after the weight on two leans"))
    ]
    return [*rows, free, turns, *mounting]


def _moments(results: Sequence[Result]) -> list[Row]:
    error = np.array([result.moments - result.true_moments for result in results])
    stated = np.array([result.error for result in results])
    share = np.abs(error) / np.array([[result.true_moments.max()] for result in results])
    good = (share < NEAR) | (np.abs(error) < DEVIATIONS * stated)
    covered = float(np.mean(np.abs(error) < DEVIATIONS * stated))
    scale = np.abs([result.scale_ratio - 1.0 for result in results])
    scale_covered = float(np.mean(scale < DEVIATIONS * np.array([result.scale_error for result in results])))
    low, high = COVERAGE
    within, near = f"{low:.0%} to {high:.0%}", "moments within 2 % of the largest, or 2 standard errors"
    return [
        Row(near, f"{good.sum()} of {good.size}", "all", bool(good.all())),
        Row("largest error of a moment, of the arm's largest", f"{share.max():.2%}", "", True),
        Row("moments within 2 standard errors", f"{covered:.0%}", within, low <= covered <= high),
        Row("torque scales: largest error", f"{scale.max():.2%}", "", True),
        Row("torque scales within 2 standard errors", f"{scale_covered:.0%}", "", True),
    ]  # fmt: skip


def _torques(results: Sequence[Result]) -> list[Row]:
    held_out = max(float(np.nanmax(np.abs(result.held_out))) / result.peak for result in results)
    new_pose = max(result.new_pose / result.peak for result in results)
    poses, minutes = max(result.poses for result in results), max(result.minutes for result in results)
    speed = max(result.speed[0] for result in results), max(result.speed[1] for result in results)
    return [
        Row("torque of a pose held out, largest error, of peak", f"{held_out:.2%}", "2 %", held_out < HELD_OUT),
        Row("true torque in 300 new poses, largest error, of peak", f"{new_pose:.2%}", "2 %", new_pose < HELD_OUT),
        Row("gravity: poses", f"{poses}", f"{MAX_POSES}", poses <= MAX_POSES),
        Row("gravity: arm time", f"{minutes:.1f} min", f"{MAX_MINUTES:g} min", minutes <= MAX_MINUTES),
        Row("fastest joint, commanded 0.3 rad/s: 99.9 % and largest", f"{speed[0]:.2f} {speed[1]:.2f} rad/s", "", True),
    ]  # fmt: skip


def _holding(results: Sequence[Result]) -> list[Row]:
    least, most = min(result.creep[0] for result in results), max(result.creep[1] for result in results)
    return [
        Row("creep before, slowest device", f"{least:.0f} deg/min", f"above {BEFORE:g}", least > BEFORE),
        Row("creep after, fastest device", f"{most:.2f} deg/min", f"below {AFTER:g}", most < AFTER),
    ]


def progress(result: Result) -> str:
    """Return the line of one device."""
    error = np.abs(result.moments - result.true_moments)
    inside = int((error < DEVIATIONS * result.error).sum())
    held_out = float(np.nanmax(np.abs(result.held_out))) / result.peak
    right = "motors right" if all(result.motors_right) else "MOTORS WRONG"
    worst = float(error.max() / result.true_moments.max())
    before, after = (f"{value:.2f}" if math.isfinite(value) else "?" for value in result.creep)
    return (
        f"device {result.seed}: {right}, IMU {result.imu_error[0]:.1f}, then {result.imu_error[1]:.1f} deg off, "
        f"moments {worst:.2%} off, {inside} of 8 within 2 SE, held out {held_out:.2%} of peak, "
        f"{result.minutes:.1f} min, creep {before} to {after} deg/min"
    )
