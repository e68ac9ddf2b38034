"""Runs one fault case on a rig and judges what the bus showed."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from ..support.launched_nodes import REAL, Parameters
from .cases import FaultCase
from .response import Response, measure_response
from .rigs import Rig

OBSERVATION = 3.0  # s for which an arm that may stay carried is observed
REST = 1.0  # s for which an arm that was let down must stay down after the fault has cleared
DESCENT = 40.0  # s until the arm must be down
MAX_SPEED = 1.0  # rad/s
LOG_LINES = 20

Result = dict[str, Any]  # a row of the table; `unsafe` is empty, or states why the case failed


def run_case(case: FaultCase, rig: Rig) -> Result:
    """Inject the fault into the carried arm and return the result.

    Too late a reaction is unsafe only with the time-outs of a real device.
    """
    rig.carry()
    probe, first_line, fault_time = rig.probe, len(rig.log), time.time()
    case.inject(rig)
    if case.limit is None:
        end = time.monotonic() + OBSERVATION
        probe.wait_until(lambda: time.monotonic() > end or probe.state == "fault")
    if case.limit is not None or probe.state in ("letting down", "fault"):
        probe.wait_until(lambda: probe.state == "fault" or (rig.have_ended and rig.listener.motors_are_off()), DESCENT)
    outcome = _outcome(rig)
    case.clear(rig)
    if outcome != "active":  # a motor that was unreachable is switched off as soon as it answers again
        probe.wait_until(rig.listener.motors_are_off, DESCENT)
    end = time.monotonic() + REST
    probe.wait_until(lambda: time.monotonic() > end)
    response = measure_response(list(rig.listener.frames), fault_time, 1.0 / rig.rate)
    return _result(case, rig, outcome, response, rig.log[first_line:])


def _outcome(rig: Rig) -> str:
    """Return 'stopped', the code of the latched fault, or the bridge's state."""
    if rig.have_ended:
        return "stopped"
    probe = rig.probe
    return str(probe.fault if probe.state == "fault" else probe.state)


def _result(case: FaultCase, rig: Rig, outcome: str, response: Response, log: list[str]) -> Result:
    carried = outcome == "active"
    failures = {
        "not let down": not carried and response.reaction is None,
        "stayed carried": carried and case.limit is not None,
        "too late": rig.timing is REAL and case.limit is not None and (response.reaction or 0.0) > case.limit,
        "too fast": response.top_speed > MAX_SPEED,
        "torque step": response.excess > 0.0,
        "enabled again": response.re_enabled,
        "exception": any("Traceback" in line for line in log),
    }
    return {
        "fault": case.name,
        "result": outcome,
        "reaction_ms": None if carried else round((response.reaction or 0.0) * 1000),
        "limit_ms": case.limit and round(case.limit * 1000),
        "top_speed_rad_s": round(response.top_speed, 2),
        "torque_step_nm": round(response.largest_step, 3),
        "latched": "held" if carried else "NO" if response.re_enabled else "yes",
        "unsafe": ", ".join(failure for failure, failed in failures.items() if failed),
    }


def not_run(case: FaultCase, error: BaseException) -> Result:
    """Return the result of a case that could not be run to its end."""
    figures = dict.fromkeys(("reaction_ms", "limit_ms", "top_speed_rad_s", "torque_step_nm", "latched"))
    reason = str(error) or type(error).__name__
    return {"fault": case.name, "result": "not run", **figures, "unsafe": "not run", "log": reason.splitlines()}


class RigPool:
    """Keeps a rig for the next case of its type. A context manager: the rig ends with it."""

    def __init__(self, folder: Path, timing: Mapping[str, Parameters] = REAL) -> None:
        self._folder, self._timing = folder, timing
        self._rig: Rig | None = None
        self._count = 0

    def __enter__(self) -> RigPool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._close()

    def run(self, case: FaultCase) -> Result:
        """Run `case` on a rig of its type; an unsafe result has the last lines of the nodes' `log` too."""
        rig = self._rig_for(case)
        try:
            result = run_case(case, rig)
        except BaseException:
            self._close()
            raise
        if case.ends_rig or result["unsafe"]:
            self._close()
        if result["unsafe"]:
            result["log"] = rig.log[-LOG_LINES:]
        return result

    def _rig_for(self, case: FaultCase) -> Rig:
        if self._rig is not None and (type(self._rig) is not case.rig or self._rig.have_ended):
            self._close()
        if self._rig is None:
            self._count += 1
            folder = self._folder / str(self._count)
            folder.mkdir()
            self._rig = case.rig(folder, self._timing)
        return self._rig

    def _close(self) -> None:
        rig, self._rig = self._rig, None
        if rig is not None:
            rig.close()
