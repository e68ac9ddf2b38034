# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Runs one row of the fault matrix on a rig, and decides whether it was safe."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from exo_gravity.sim.judge import Response, measure

from ..support.ros_probe import Timeout
from .fault_case import AFTER_EXIT, BEFORE, CARRYING, DESCENT, OBSERVATION, TOO_LATE, FaultCase
from .rig import Rig
from .rigs import BothArmsRig

LOG_LINES = 20

FIGURES = (
    *("reaction_ms", "limit_ms", "top_speed_rad_s", "driven_rad_s", "fastest_joint"),
    *("torque_step_nm", "energy_j", "power_w", "damping_of_rated", "off_s"),
)
Result = dict[str, Any]  # a row of the table; `unsafe` is empty, or states why the case failed


def run_case(case: FaultCase, rig: Rig) -> Result:
    """Inject the fault at its stage and return the result.

    Too late a reaction is unsafe only with the shipped time-outs.
    """
    rig.bring_to(case.stage)
    first_line = len(rig.log)
    fault_time = time.time()
    injected = case.inject(rig)
    fault_time = injected if isinstance(injected, float) else fault_time
    with contextlib.suppress(Timeout):  # then the arm is still carried
        _observe(case, rig)
    case.clear(rig)
    with contextlib.suppress(Timeout):  # then it is not down
        if rig.truth.motors_are_off():  # the last state of a killed bridge stands until the launcher has ended
            rig.probe.wait_until(lambda: _outcome(rig) not in CARRYING, DESCENT)
        if _outcome(rig) not in CARRYING and not case.must_stay_off:
            _wait_until_down(rig)
    outcome = _outcome(rig)
    records = rig.truth.since(fault_time - BEFORE)
    response = case.response(records, fault_time, 1.0 / rig.rate, [motor.spec for motor in rig.motors])
    failures = _failures(case, rig, outcome, records, fault_time, response)
    if any("Traceback" in line for line in rig.log[first_line:]):
        failures.append("exception")
    if not rig.nodes[0].log:
        failures.append("empty log")
    if not failures:
        try:
            case.afterwards(rig)
        except AssertionError as error:
            failures.append(f"afterwards: {str(error).splitlines()[0]}")
    return _result(case, outcome, response, failures)


def _observe(case: FaultCase, rig: Rig) -> None:
    """Wait until the arm is let down, or for OBSERVATION if it may stay as it is."""
    probe, end = rig.probe, time.monotonic() + OBSERVATION
    if case.limit is None or case.must_stay_off:
        probe.wait_until(lambda: time.monotonic() > end or probe.state == "fault")
        if probe.state not in ("letting down", "fault"):
            return
    # A bridge that has given up a motor that it cannot reach is in `fault`, and that motor still on.
    probe.wait_until(lambda: probe.state == "fault" or rig.truth.motors_are_off(), DESCENT)


def _wait_until_down(rig: Rig) -> None:
    arms = [rig.truth, rig.left_truth] if isinstance(rig, BothArmsRig) and rig.have_ended else [rig.truth]
    rig.probe.wait_until(lambda: all(arm.motors_are_off() for arm in arms), DESCENT)
    end = time.monotonic() + AFTER_EXIT
    rig.probe.wait_until(lambda: time.monotonic() > end)


def _outcome(rig: Rig) -> str:
    """Return 'stopped', the code of the latched fault, or the bridge's state."""
    if rig.have_ended:
        return "stopped"
    probe = rig.probe
    return str(probe.fault if probe.state == "fault" else probe.state or "inactive")


def _failures(
    case: FaultCase, rig: Rig, outcome: str, records: np.ndarray, fault_time: float, response: Response
) -> list[str]:
    """Return what was unsafe."""
    wrong = case.failures(outcome, records, fault_time, response, len(rig.motors))
    if not rig.shipped_timeouts:
        wrong = [failure for failure in wrong if failure != TOO_LATE]
    if isinstance(rig, BothArmsRig):
        left = rig.left_truth.since(fault_time - BEFORE)
        other = measure(left, fault_time, 1.0 / rig.rate) if len(left) else Response()
        if not len(left) or other.top_speed > case.speed_limit:
            wrong.append("left arm too fast")
        if other.excess > 0.0:
            wrong.append("torque step of the left arm")
    return wrong


def _result(case: FaultCase, outcome: str, response: Response, failures: list[str]) -> Result:
    carried = outcome in CARRYING
    return {
        "fault": case.name,
        "stage": case.stage,
        "result": outcome,
        "reaction_ms": None if carried or response.reaction is None else round(response.reaction * 1000),
        "limit_ms": case.limit and round(case.limit * 1000),
        "top_speed_rad_s": round(response.top_speed, 2),
        "driven_rad_s": round(response.driven, 2),
        "fastest_joint": response.fastest,
        "torque_step_nm": round(response.largest_step, 3),
        "energy_j": round(response.energy, 3),
        "power_w": round(response.power, 2),
        "damping_of_rated": round(response.damping, 2),
        "off_s": None if carried or response.off is None else round(response.off, 1),
        "unsafe": ", ".join(failures),
    }


def not_run(case: FaultCase, error: BaseException) -> Result:
    """Return the result of a case that could not be run to its end."""
    reason = (str(error) or type(error).__name__).splitlines()[0]
    unsafe = f"not run: {reason}"
    return {"fault": case.name, "stage": case.stage, "result": "not run", **dict.fromkeys(FIGURES), "unsafe": unsafe}


class RigPool:
    """Keeps the `rig` of the last case for the next case of its type. A context manager: the rig ends with it."""

    def __init__(self, folder: Path, shipped_timeouts: bool = True) -> None:
        self._folder, self._shipped_timeouts = folder, shipped_timeouts
        self.rig: Rig | None = None
        self._count = 0

    def __enter__(self) -> RigPool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._close()

    def run(self, case: FaultCase) -> Result:
        """Run `case` on a rig of its type; an unsafe result has the last lines of the nodes' `log` too."""
        rig = self.rig_for(case.rig or Rig)
        try:
            result = run_case(case, rig)
        except Exception as error:  # the other cases may still show something
            result = not_run(case, error)
        except BaseException:
            self._close()
            raise
        if case.ends_rig or result["unsafe"]:
            self._close()
        if result["unsafe"]:
            result["log"] = rig.log[-LOG_LINES:]
        return result

    def rig_for(self, kind: type[Rig]) -> Rig:
        """Return the running rig of this kind."""
        if self.rig is not None and (type(self.rig) is not kind or self.rig.have_ended):
            self._close()
        if self.rig is None:
            self._count += 1
            folder = self._folder / str(self._count)
            folder.mkdir()
            self.rig = kind(folder, self._shipped_timeouts)
            self.rig.start()
        return self.rig

    def _close(self) -> None:
        rig, self.rig = self.rig, None
        if rig is not None:
            rig.close()
