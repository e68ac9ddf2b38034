# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The bench acceptance, run on the simulated device in virtual time, where its motors can be set up wrongly."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import pytest

from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.vocabulary import Source
from exo_gravity.lab.acceptance import STEPS, Bench, BenchStep, Lift, Weight, accept, record
from exo_gravity.lab.calibration.moment_model import MomentModel
from exo_gravity.lab.calibration.tours import model_of
from exo_gravity.lab.inputs.arms import configured_arm, node_values
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.sim import ArmConfig, Firmware, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.params import device_of, simulator_table
from exo_gravity.sim.virtual_arm import VirtualArm

from ..support.simulated_device import SPECS
from ..support.thorough import quick

RATE = 125.0  # Hz
WEIGHT = Weight(0.6, 0.2)  # on a forearm that the device carries from the beginning
MOTORS = tuple(JointMotor(spec, can_id) for can_id, spec in enumerate(SPECS, 1))
LIMITS = Limits(("a", "b", "c", "elbow"))
NAMES = [step.__name__ for step in STEPS]


class Person:
    """Does what is asked; the loop runs meanwhile."""

    def __init__(self) -> None:
        self.arm: VirtualArm | None = None
        self.said: list[str] = []
        self.forgets_the_supply = False

    def ask(self, request: str, watch: Callable[[], str]) -> None:
        is_switched = "switch the motors' supply off and on" in request and not self.forgets_the_supply
        for on in (False, True) if is_switched else (True,):
            for motor in self.arm.device.motors:
                motor.unplugged = not on
            for _ in range(20):
                self.arm.run(0.05)
                watch()


def loaded_links():
    """The simulated arm's links with the weight on the last one."""
    mass, cog = DEFAULT_LINKS.mass.copy(), DEFAULT_LINKS.cog.copy()
    cog[-1] = (mass[-1] * cog[-1] + WEIGHT.mass * WEIGHT.lever) / (mass[-1] + WEIGHT.mass)
    mass[-1] += WEIGHT.mass
    return replace(DEFAULT_LINKS, mass=mass, cog=cog)


def acceptance(
    true: tuple[JointMotor, ...] = MOTORS, assumed: tuple[JointMotor, ...] = MOTORS, **spoil
) -> list[BenchStep]:
    """Run the acceptance of a device with the motors `true`, which the file takes for `assumed`.

    spoil: attributes of the person, `temperature` of the first motor, or `timeout` of the firmware.
    """
    firmware = Firmware(timeout=spoil.pop("timeout", 0.0))
    boards = [SimulatedMotor(one, firmware) for one in true]
    device = SimulatedDevice(SimulatedArm(ArmConfig(links=loaded_links())), boards)
    person = Person()
    for motor in device.motors[1:]:
        motor.temperature = 25.0
    device.motors[0].temperature = spoil.pop("temperature", 25.0)
    for name, value in spoil.items():
        setattr(person, name, value)
    return played(device, assumed, LIMITS, MomentModel(DEFAULT_LINKS, True), WEIGHT, person, RATE)


def played(
    device: SimulatedDevice,
    assumed: tuple[JointMotor, ...],
    limits: Limits,
    model: MomentModel,
    weight: Weight,
    person: Person,
    rate: float,
) -> list[BenchStep]:
    """Run the acceptance of `device`, which already carries the weight; the rest is what the file says."""
    lift = Lift(limits, 1.0 / rate)
    person.arm = arm = VirtualArm(device, lift, assumed, limits, rate)
    bench = Bench(arm.loop, lift, assumed, model, weight, arm.run, person.ask, arm.clock)
    results = accept(bench, person.said.append)
    assert not device.powered
    assert len(person.said) == len(results)
    arm.bus.stop()
    return results


def of_urdf(name: str, weight: Weight, scale: float = 1.0) -> list[BenchStep]:
    """Run the acceptance of an arm of config whose motors give `scale` of what they are commanded."""
    params = packaged_config(f"{name}.yaml")
    arm, nodes = configured_arm(params, "right"), load(params)
    none, simulator = [0.0] * (len(arm.motors) - 1), nodes["/right/simulator"]
    simulator |= {"wearer.mass": [*none, weight.mass], "wearer.cog": [*none, weight.lever]}
    simulator["torque_scale"] = [scale] * len(arm.motors)
    device = device_of(node_values(nodes, "/right/simulator", simulator_table(simulator)))
    for motor in device.motors:
        motor.temperature = 25.0
    return played(device, arm.motors, arm.limits, model_of(arm), weight, Person(), arm.can_bridge["rate"])


def with_timeout(timeout: float) -> tuple[JointMotor, ...]:
    return (*MOTORS[:3], replace(MOTORS[3], timeout=timeout))


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
    measured = results[NAMES.index("torque")].measured
    assert measured["ratio"] == pytest.approx(1.0, abs=0.15)
    assert not record(results[:-1], "right", Source.REAL)["passed"]  # a step is missing


def test_an_arm_from_a_urdf_passes_every_step_and_one_with_weak_motors_fails_at_the_known_weight():
    weight = Weight(1.0, 0.2)
    results = of_urdf("three_joints", weight)
    assert failed(results) == "", results[-1].sentence
    assert failed(of_urdf("three_joints", weight, scale=0.6)) == "torque"


def test_a_weight_that_the_last_joint_hardly_feels_is_refused():
    results = of_urdf("three_joints", Weight(0.05, 0.02))
    assert failed(results) == "torque" and "must be at least 0.3: take a heavier one" in results[-1].sentence


WRONG_RANGE = (*MOTORS[:3], replace(MOTORS[3], spec=replace(MOTORS[3].spec, torque_range=9.0)))
SPOILT = {  # what is the case, the step that fails, and what is said
    "a cold motor without the offset of its temperature": ({"temperature": -15.0}, "cold", ""),
    "a supply that was not switched": ({"forgets_the_supply": True}, "zero", ""),
    "another torque range": ({"true": WRONG_RANGE}, "torque", "ratio"),
    "no time-out": ({"assumed": with_timeout(0.2)}, "time_out", "the motor held; it must let go"),
    "a time-out": ({"assumed": with_timeout(0.0), "timeout": 0.2}, "time_out", "the motor let go; it must hold"),
}


@pytest.mark.parametrize("case", quick(list(SPOILT)[:2], SPOILT))
def test_what_is_not_as_the_file_says_fails_at_its_step(case):
    spoil, step, said = SPOILT[case]
    results = acceptance(**spoil)
    assert failed(results) == step and said in results[-1].sentence


def test_the_moments_of_the_weight_are_those_of_the_loaded_links():
    bench = Bench(None, None, MOTORS, MomentModel(DEFAULT_LINKS, True), WEIGHT, None, None, None)
    assert bench.moments == pytest.approx(loaded_links().moments)
