# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The bench acceptance, run on the simulated device in virtual time, where its motors can be set up wrongly."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from unittest.mock import Mock

import pytest

from exo_gravity.core.vocabulary import NO_REASON, Source
from exo_gravity.lab.acceptance import STEPS, Bench, BenchStep, Lift, Weight, accept, record
from exo_gravity.lab.calibration.tours import model_of
from exo_gravity.lab.inputs.arms import configured_arm, node_values
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.sim.params import device_of, simulator_table
from exo_gravity.sim.virtual_arm import VirtualArm

from ..support.thorough import quick

SIMULATOR = "/right/simulator"
WEIGHT, ON_URDF = Weight(0.6, 0.2), Weight(1.0, 0.2)
NAMES = [step.__name__ for step in STEPS]


class Person:
    """Does what is asked; the loop runs meanwhile. supply: whether it is on, in turn, when they are to switch it."""

    def __init__(self, supply: Sequence[bool]) -> None:
        self.arm: VirtualArm | None = None
        self.said: list[str] = []
        self.supply = supply

    def ask(self, request: str, watch: Callable[[], str]) -> None:
        for on in self.supply if "switch the motors' supply off and on" in request else (True,):
            for motor in self.arm.device.motors:
                motor.unplugged = not on
            for _ in range(20):
                self.arm.run(0.05)
                watch()


def acceptance(
    name: str = "sim",
    weight: Weight = WEIGHT,
    supply: Sequence[bool] = (False, True),
    cold: float = 25.0,
    assumed_timeout: float | None = None,
    **simulator: object,
) -> list[BenchStep]:
    """Run the acceptance of an arm of config, whose device carries the weight from the beginning.

    supply: as for `Person`. cold: temperature of the first motor, degC. assumed_timeout: of the
    last motor, as the file has it, s. simulator: parameters of the device.
    """
    params = packaged_config(f"{name}.yaml")
    arm, nodes = configured_arm(params, "right"), load(params)
    none = [0.0] * (len(arm.motors) - 1)
    nodes[SIMULATOR] |= {"wearer.mass": [*none, weight.mass], "wearer.cog": [*none, weight.lever]}
    nodes[SIMULATOR] |= {"trunk.pitch": 0.0, "trunk.roll": 0.0, **simulator}
    device = device_of(node_values(nodes, SIMULATOR, simulator_table(nodes[SIMULATOR])))
    for motor in device.motors:
        motor.temperature = 25.0
    device.motors[0].temperature = cold
    last = arm.motors[-1]
    motors = (*arm.motors[:-1], last if assumed_timeout is None else replace(last, timeout=assumed_timeout))
    person, rate = Person(supply), arm.can_bridge["rate"]
    person.arm = played = VirtualArm(device, Lift(arm.limits, 1.0 / rate), motors, arm.limits, rate)
    bench = Bench(played.loop, motors, model_of(arm), weight, played.run, person.ask)
    results = accept(bench, person.said.append)
    assert not device.powered and len(person.said) == len(results)
    played.bus.stop()
    return results


def failed(results: list[BenchStep]) -> str:
    """The name of the only step that did not pass, which is the last one, '' for none."""
    assert [result.name for result in results] == NAMES[: len(results)]
    assert all(result.passed for result in results[:-1])
    return "" if results[-1].passed else results[-1].name


def test_a_device_as_its_file_says_passes_every_step_and_leaves_a_record():
    results = acceptance()
    assert failed(results) == "", results[-1].sentence
    written = json.loads(json.dumps(record(results, "right", Source.SIMULATED), default=float))
    assert (
        written["passed"] and written["source"] == "simulated" and [step["name"] for step in written["steps"]] == NAMES
    )
    assert results[NAMES.index("torque")].measured["ratio"] == pytest.approx(1.0, abs=0.15)
    assert not record(results[:-1], "right", Source.REAL)["passed"]  # a step is missing


CASES = {  # what is the case, the step that fails, and what is said
    "a cold motor without the offset of its temperature": ({"cold": -15.0}, "cold", ""),
    "a supply that was not switched": ({"supply": (True,)}, "zero", ""),
    "a supply that stays off": ({"supply": (False,)}, "zero", "not all of them reply again"),
    "a weight that the last joint of an arm from a URDF hardly feels": (
        {"name": "three_joints", "weight": Weight(0.05, 0.02)},
        "torque",
        "must be at least 0.3: take a heavier one",
    ),
    "an arm from a URDF, as its file says": ({"name": "three_joints", "weight": ON_URDF}, "", ""),
    "weak motors": ({"torque_scale": [0.6] * 4}, "torque", "ratio"),
    "no time-out": ({"assumed_timeout": 0.2}, "time_out", "the motor held; it must let go"),
    "a time-out": ({"assumed_timeout": 0.0, "firmware.timeout": 0.2}, "time_out", "the motor let go; it must hold"),
}


@pytest.mark.parametrize("case", quick(list(CASES)[:4], CASES))
def test_what_is_not_as_the_file_says_fails_at_its_step(case):
    given, step, said = CASES[case]
    results = acceptance(**given)
    assert failed(results) == step and said in results[-1].sentence


def test_a_start_that_takes_too_long_is_none_and_a_person_who_breaks_off_is_told_of_motors_that_stay_on():
    assert "takes longer" in Bench.carry(
        Mock(
            **{"loop.safety.fault": None, "loop.safety.refusal": NO_REASON, "loop.safety.waiting_for": NO_REASON},
            **{"until.return_value": False, "motors": ()},
        )
    )
    said = Mock()
    with pytest.raises(KeyboardInterrupt):
        accept(Mock(**{"ask.side_effect": KeyboardInterrupt, "until.return_value": False}), said)
    assert "cut their supply" in said.call_args[0][0]
