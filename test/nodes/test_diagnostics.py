"""Readable values on /diagnostics, and the aggregator's configuration."""

import math
from types import SimpleNamespace

import pytest
import yaml

from exo_gravity.core.motors.bus_load import Traffic
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.limits import JointSample, Limits
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.nodes.can_bridge import report as bridge_report
from exo_gravity.nodes.can_bridge.report import BridgeReport
from exo_gravity.nodes.ros.messages import OK, WARN, Diagnostics, milliseconds, row
from exo_gravity.tools.inputs.parameter_file import load

from ..support import CONFIG

REPORTING = ("can_bridge", "compensator", "simulator", "imu")


@pytest.mark.parametrize(
    ("values", "digits", "text"),
    [
        ((100.0, -0.0001, 2.0320), 3, "100, 0, 2.032"),
        ((99.6,), 0, "100"),
        ((math.nan, -1.25), 1, "nan, -1.2"),
        ((), 3, ""),
    ],
)
def test_numbers_have_few_digits_and_no_negative_zero(values, digits, text):
    assert row(values, digits) == text


def test_an_age_is_in_milliseconds_or_none():
    assert [milliseconds(0.0123), milliseconds(math.inf)] == ["12.3", "none"]


@pytest.mark.parametrize("file", ["exo.yaml", "sim.yaml", "sim_both.yaml"])
def test_the_aggregator_shows_each_reporting_node_once(file):
    analyzers = yaml.safe_load((CONFIG / "diagnostics.yaml").read_text())["analyzers"]["ros__parameters"]
    prefixes = [entry["startswith"] for entry in analyzers.values() if isinstance(entry, dict)]
    for node in load(CONFIG / file):
        if node.split("/")[-1] in REPORTING:
            assert sum(any(node.lstrip("/").startswith(prefix) for prefix in group) for group in prefixes) == 1, node


def carrying(effort, cycles=0):
    """Return what a bridge reports on: an arm that is carried at rest, the elbow with `effort` Nm."""
    safety = SafetyMachine(Limits(("a", "b", "c", "elbow")), 0.004)
    safety.state = State.ACTIVE
    samples = [JointSample(0.5, 2.0, torque, 40, 0, 0.0) for torque in (0.0, 0.0, 0.0, effort)]
    counts = dict.fromkeys(("late", "incomplete", "cycle_errors"), 0)
    return SimpleNamespace(safety=safety, samples=samples, ignored={}, failure=None, cycles=cycles, **counts)


@pytest.fixture
def sent(node, monkeypatch):
    """A function that lets a bridge report on `loop(n)`, `count` times, 0.1 s apart; it returns the reports.

    answered: when the answered joint states were measured, s; None for always now.
    """
    reports, clock = [], SimpleNamespace(now=1000.0)
    monkeypatch.setattr(Diagnostics, "report", lambda _, *report: reports.append(report))
    monkeypatch.setattr(bridge_report, "time", SimpleNamespace(monotonic=lambda: clock.now))

    def sent(loop, count, answered=None):
        report = BridgeReport(node, ("a", "b", "c", "elbow"), Traffic(4), 0.004, (3.0, 9.0, 3.0, 3.0))
        for n in range(count):
            report.send(loop(n), "none", clock.now if answered is None else answered)
            clock.now += 0.1
        return reports

    return sent


def test_a_motor_that_stays_above_its_rated_torque_is_named_with_load_and_power(sent):
    reports = sent(lambda n: carrying(6.0, 25 * n), 1200, answered=-math.inf)
    assert reports[20][:2] == (OK, "active")
    level, message, values = reports[-1]
    assert (level, message) == (WARN, "active, above rated torque for too long: elbow")
    assert values["elbow power (W)"] == "12" and values["elbow torque (Nm)"] == "6"
    assert 180 < int(values["elbow RMS of rated torque (%)"]) < 200 and values["a RMS of rated torque (%)"] == "0"
    assert values["rate (Hz)"] == "250.0" and values["age of efforts (ms)"] == "none"


def test_a_loop_below_its_rate_is_reported(sent):
    reports = sent(lambda n: carrying(1.0, 20 * n), 30)
    assert reports[-1][:2] == (WARN, "active, slower than 225 Hz")
