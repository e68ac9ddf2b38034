"""The gap meter: what counts as a stall of the device and as a silence of its controller."""

import pytest

from exo_gravity.sim.device import GapMeter


def passes(meter, times, powered=True, commanded=True):
    for now in times:
        meter.note(now, powered, commanded)


def test_a_device_that_runs_regularly_has_short_gaps():
    meter = GapMeter()
    passes(meter, (0.0, 0.002, 0.004, 0.006))
    assert meter.longest_stall == pytest.approx(0.002)
    assert meter.longest_silence == pytest.approx(0.002)


def test_a_device_that_is_not_run_is_a_stall_and_a_silence():
    meter = GapMeter()
    passes(meter, (0.0, 0.002, 0.142, 0.144))
    assert meter.longest_stall == pytest.approx(0.14)
    assert meter.longest_silence == pytest.approx(0.14)


def test_a_controller_that_sends_nothing_is_a_silence_but_no_stall():
    meter = GapMeter()
    passes(meter, (0.0, 0.002))
    passes(meter, (0.002 * n for n in range(2, 42)), commanded=False)
    assert meter.longest_stall == pytest.approx(0.002)
    assert meter.longest_silence == pytest.approx(0.08)


def test_gaps_while_the_motors_are_off_do_not_count():
    meter = GapMeter()
    passes(meter, (0.0, 0.3), powered=False, commanded=False)
    passes(meter, (0.6, 0.602))
    assert meter.longest_stall == meter.longest_silence == pytest.approx(0.002)


def test_the_measurement_starts_again_when_the_motors_are_switched_on_again():
    meter = GapMeter()
    passes(meter, (0.0, 0.3))
    passes(meter, (0.4,), powered=False)
    assert meter.longest_stall == pytest.approx(0.3)
    passes(meter, (0.5, 0.502))
    assert meter.longest_stall == pytest.approx(0.002)
