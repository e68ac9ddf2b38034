"""Tasks of the effort study as steps of a script: the log of the true motion gives the same effort as the study."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trial.script import TrialScript
from exo_gravity.sim import SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.effort import measure
from exo_gravity.sim.effort_script import ScriptedWearer, effort_script, efforts_of_truth
from exo_gravity.sim.effort_study import REACH, SWEEPS
from exo_gravity.sim.truth import TruthLog

from ..support.terms_run import MOTORS_OF_ARM

RATE = 250.0


def make_device() -> SimulatedDevice:
    return SimulatedDevice(SimulatedArm(), [SimulatedMotor(motor) for motor in MOTORS_OF_ARM])


def test_the_log_of_a_script_gives_the_effort_that_the_study_measures(tmp_path):
    script = TrialScript.parse(effort_script([REACH, SWEEPS[3]]))
    device = make_device()
    device.truth = TruthLog(tmp_path / "truth.bin")
    device.start(ScriptedWearer(script), 0.5)
    device.advance(script.duration + 1.0)
    found = efforts_of_truth(tmp_path / "truth.bin", script)
    assert list(found) == ["reach", "sweep 4"]
    for task in (REACH, SWEEPS[3]):
        expected = measure(make_device(), MOTORS_OF_ARM, None, task, RATE)
        np.testing.assert_allclose(found[task.name].rms, expected.rms, rtol=0.02, atol=0.2)
        assert found[task.name].jerk == pytest.approx(expected.jerk, rel=0.05)
    assert found["sweep 4"].felt == pytest.approx(expected.felt, rel=0.05, abs=0.005)


def test_a_task_that_was_cut_short_has_no_effort(tmp_path):
    script = TrialScript.parse(effort_script([REACH]))
    device = make_device()
    device.truth = TruthLog(tmp_path / "truth.bin")
    device.start(ScriptedWearer(script))
    device.advance(script.duration - 2.0)
    assert efforts_of_truth(tmp_path / "truth.bin", script) == {}


def test_an_unknown_task_is_refused_by_its_name():
    script = TrialScript.parse({"name": "x", "steps": [{"hold": 1.0}, {"task": "juggle", "over": 3.0}]})
    with pytest.raises(ParameterError, match=r"steps\[1\].task = 'juggle': must be one of poses, reach"):
        ScriptedWearer(script)
