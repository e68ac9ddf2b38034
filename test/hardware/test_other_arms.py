# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What happens to arms on CAN happens to an elbow and to seven joints: by the same bounds, on what the motors did."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest

from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.safety.drive import State
from exo_gravity.lab.controllers import DirectController
from exo_gravity.lab.inputs.arms import carried_arm, node_values
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.sim.judge import Driven, driven
from exo_gravity.sim.params import device_of, simulator_table
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.truth import TruthRecords
from exo_gravity.sim.virtual_arm import VirtualArm
from exo_gravity.sim.virtual_wearer import VirtualWearer

from ..support.copies import prepared
from ..support.thorough import quick
from .carried_arm import DRIVEN, ENERGY, UNKNOWN_LOSS

POSES = {"elbow": [1.0], "seven_joints": [0.4, 0.3, 0.1, 0.6, 0.1, 0.2, -0.1]}  # rad
RATE = 250.0  # Hz


class ShippedArm(VirtualArm):
    """The simulated arm of a file in config, carried, in its pose of `POSES`."""

    def __init__(self, name: str) -> None:
        nodes = load(packaged_config(f"{name}.yaml"))
        arm = carried_arm(nodes, "/right")
        device = device_of(node_values(nodes, "/right/simulator", simulator_table(nodes["/right/simulator"])))
        controller = DirectController(Compensator(arm.settings, arm.limits.joint_names), arm.limits)
        super().__init__(device, controller, arm.motors, arm.limits, RATE)
        self.enable()
        assert self.run_until(lambda: self.safety.state in (State.ACTIVE, State.FAULT), 60.0), self.safety.waiting_for
        assert self.safety.state is State.ACTIVE, self.safety.fault
        script = TrialScript.parse({"name": "raise", "steps": [{"move": POSES[name], "over": 2.0}]})
        device.start(VirtualWearer(script))
        self.run(3.0)
        device.truth = TruthRecords()

    @property
    def caused(self) -> Driven:
        """What the motors caused."""
        assert isinstance(self.device.truth, TruthRecords)
        return driven(self.device.truth.records, [motor.joint.spec for motor in self.device.motors])


shipped_arm = prepared(ShippedArm)


def cut(duration: float, joint: int | None = None) -> Callable[[ShippedArm], None]:
    def act(arm: ShippedArm) -> None:
        for own in range(len(arm.device.motors)) if joint is None else (joint,):
            arm.device.unplug(own, duration)

    return act


LOST = {
    "all motors restart in 80 ms": cut(0.08),
    "supply cut for 3 s": cut(3.0),
    "motor 1 loses its power for 1 s": cut(1.0, 0),
}
EVENTS: dict[str, Callable[[ShippedArm], None]] = {
    "let down": lambda arm: arm.safety.disable(arm.now),
    "loop stalls for 60 ms": lambda arm: arm.clock.stall(0.06),
    "loop stalls for 300 ms": lambda arm: arm.clock.stall(0.3),
    **LOST,
}


CASES = list(itertools.product(POSES, EVENTS))
# Seven joints take eight times as long as the elbow.
QUICK = [case for case in CASES if case[0] == "elbow"]


@pytest.mark.parametrize(("name", "event"), quick(QUICK, CASES))
def test_whatever_happens_the_motors_of_other_arms_drive_no_joint(name: str, event: str) -> None:
    arm = shipped_arm(name)
    EVENTS[event](arm)
    arm.run(4.0)
    if arm.safety.state is not State.ACTIVE:
        arm.run_until(lambda: arm.loop.is_off, 11.0)
    caused = arm.caused
    speed, energy = UNKNOWN_LOSS if event in LOST else (DRIVEN, ENERGY)
    assert caused.speed < speed and caused.energy < energy, caused
    assert arm.safety.state is State.ACTIVE or not arm.device.powered
