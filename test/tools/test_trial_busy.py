"""A trial on a computer that is too busy for the simulated device: repeated, then reported in the last line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from exo_gravity.core.errors import DataError
from exo_gravity.tools import trial
from exo_gravity.tools.launcher import StopFlag
from exo_gravity.tools.trials import run as running
from exo_gravity.tools.trials.run import TrialEnd, too_busy

SILENT = {"level": 2, "message": "letting down: motor_silent", "state": "letting down", "fault": "motor_silent"}
STALE = {**SILENT, "message": "letting down: command_stale", "fault": "command_stale"}
HOT = {**SILENT, "message": "letting down: over_temperature", "fault": "over_temperature"}


def simulator(stall: float = 12.0, silence: float = 14.0, disconnected: str = "no") -> dict[str, Any]:
    return {
        "level": 0,
        "message": "running",
        "longest stall (ms)": f"{stall:.0f}",
        "longest silence (ms)": f"{silence:.0f}",
        "disconnected": disconnected,
    }


CASES = {
    "a stalled device": (SILENT, simulator(140, 150), "right/simulator was not run for 140 ms"),
    "a stalled bridge": (SILENT, simulator(12, 130), "right/can_bridge was not run for 130 ms"),
    "late replies without a long gap": (SILENT, simulator(), "the replies of the simulated motors came too late"),
    "late efforts": (STALE, simulator(), "the efforts came too late"),
    "a simulated fault": (SILENT, simulator(60, 70, "yes"), ""),
    "a hot motor": (HOT, simulator(140, 150), ""),
}


@pytest.mark.parametrize(("bridge", "device", "reason"), CASES.values(), ids=CASES)
def test_only_a_gap_and_late_replies_or_efforts_mean_a_busy_computer(bridge, device, reason):
    assert too_busy({"right/can_bridge": bridge, "right/simulator": device}) == reason


def test_a_real_arm_is_never_excused_by_a_busy_computer():
    assert too_busy({"right/can_bridge": STALE}) == too_busy({"right/can_bridge": SILENT}) == ""


class Attempts:
    """Stands for the nodes: each attempt ends in the next of the given ways, and records nothing."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *ends: TrialEnd) -> None:
        self.ends = list(ends)
        monkeypatch.setattr(running, "run_nodes", lambda *arguments: self.ends.pop(0))
        monkeypatch.setattr("exo_gravity.bag.reader.read_bag", self._no_recording)
        monkeypatch.setattr(trial, "stop_on_signals", StopFlag)

    @staticmethod
    def _no_recording(path: Path) -> None:
        raise DataError(f"{path}: nothing was recorded")


BUSY = TrialEnd("right/can_bridge: letting down: motor_silent", 1, "right/simulator was not run for 140 ms")
FAULT = TrialEnd("right/can_bridge: letting down: over_temperature", 1, "")
LAST_LINE = (
    "trial: this computer was too busy: right/simulator was not run for 140 ms. "
    "Close other programs and try again. The arm has no fault."
)


def run(tmp_path: Path) -> int:
    return trial.main(["demo", "--output", str(tmp_path)])


def test_a_busy_computer_ends_a_trial_with_exit_code_3_and_advice_in_the_last_line(tmp_path, monkeypatch, capsys):
    attempts = Attempts(monkeypatch, BUSY, BUSY, BUSY)
    assert run(tmp_path) == 3
    assert attempts.ends == []
    assert capsys.readouterr().out.splitlines()[-1] == LAST_LINE


def test_a_trial_that_failed_on_a_busy_computer_is_repeated(tmp_path, monkeypatch, capsys):
    attempts = Attempts(monkeypatch, BUSY, FAULT)
    assert run(tmp_path) == 1
    assert attempts.ends == []
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "this computer was too busy: right/simulator was not run for 140 ms; attempt 2 of 3"
    assert lines[-1] == "trial: right/can_bridge: letting down: over_temperature"


def test_a_fault_of_the_arm_is_not_repeated(tmp_path, monkeypatch):
    attempts = Attempts(monkeypatch, FAULT, BUSY)
    assert run(tmp_path) == 1
    assert attempts.ends == [BUSY]
