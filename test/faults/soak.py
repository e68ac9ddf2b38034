# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m test.faults.soak [--minutes 60] [--seed 1]: both arms, live changes, an active wearer, harmless faults.

In each row the operator changes the right arm's load at random, while it is free and while its wearer reaches, shakes,
throws, pushes or holds it; by chance a fault strikes it then. All are judged as in the fault matrix, and the arm must
be carried again each time. The left arm is also carried, and a recorder runs throughout.

The exit code is 1 if a row was unsafe, the recording has losses or gaps, or a node's memory grew by more than
MAX_GROWTH.
"""

import argparse
import random
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.sim.judge import measure

from .fault_case import Action, Arm, FaultCase, Parameters, in_turn, pause
from .run import Pool, pool_of  # first: it chooses the ROS domain

from .processes import CONTINUE, MESSAGES, STOP, ProcessRig, send  # isort: skip
from ..support.launched_nodes import CALM  # isort: skip
from .virtual import AK_ERROR
from .virtual_cases import KEEP, MOVED, PUSH_DOWN, RATED, ROBOT, SHAKE, THROW, WORN, Steps

WARM_UP = 5  # rows until memory counts: caches and buffers fill
MAX_GROWTH = 5.0  # MB, from then until the end
MAX_GAP = 1.0  # s between two recorded joint states of an arm
SOAK = replace(WORN, base="sim_both.yaml", rate=50.0)
NODES = (
    *("/imu", "/recorder"),
    *(f"/{side}/{node}" for side in ("right", "left") for node in ("can_bridge", "compensator")),
)
CARRIED: Parameters = {**WORN.compensator, "robot.mass": list(ROBOT.mass), **RATED}
BACK: Steps = [{"move": list(SOAK.pose), "over": over} for over in (1.5, 60.0)]  # where the wearer carries their arm
# As the virtual wearer's 25 Nm permit while the motors do not carry them.
ACTS: dict[str, Steps] = {
    "lifts": [{"move": [0.0, 1.0, 0.3, 1.0], "over": 1.6}],
    "pushes down": PUSH_DOWN,
    "holds": KEEP,
    "shakes": SHAKE,
    "throws": [*THROW, {"hold": 0.5}],
    "reaches": [{"move": pose, "over": 1.0} for pose in ([0.3, 0.9, 0.6, 1.0], list(SOAK.pose)) * 3],
}


class SoakRig(ProcessRig):
    """Both arms carry the arm of a 75 kg wearer, and a recorder runs."""

    timing: ClassVar[Mapping[str, Parameters]] = CALM  # so that an ordinary computer has time left

    def __init__(self, arm: Arm, folder: Path) -> None:
        super().__init__(arm, folder)
        self.nodes.add("/recorder", output=str(folder / "bag"))

    def memory(self) -> list[float]:
        """Return the resident memory of each of NODES in MB."""
        return [resident(self.pid(node)) for node in NODES]


def resident(pid: int) -> float:
    """Return the resident memory of a process in MB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1e3


def wearer(steps: Steps) -> Action:
    """Let the wearer do these steps of a trial script from now on."""
    return lambda rig: rig.set("simulator", {"trial": str(rig.write_script(f"wearer_{time.monotonic_ns()}", steps))})


def load(change: Parameters) -> Action:
    """Let the operator change the load."""
    return lambda rig: rig.set("compensator", {**CARRIED, **change})


def some_change(dice: random.Random) -> Parameters:
    """Return in what a load differs from CARRIED."""
    *links, last = ROBOT.mass
    changes: tuple[Parameters, ...] = (
        {"mode": "one_g"},
        {"support": round(dice.random(), 2)},
        {"wearer.body_mass": round(dice.uniform(50.0, 100.0), 1)},
        {"robot.mass": [*links, round(last + dice.uniform(0.0, 1.0), 2)]},  # a payload
        {"max_effort": [round(dice.uniform(0.2, 1.0) * most, 2) for most in RATED["max_effort"]]},
    )
    return dice.choice(changes)


def not_driven(records: np.ndarray) -> str:
    """Return how fast the motors drove the arm, if they did."""
    speed = measure(records, records["time"][0], 1.0 / SOAK.rate).driven
    return f"driven at {speed:.2f} rad/s" if speed > MOVED else ""


def is_carried_where_the_wearer_let_go(rig: SoakRig) -> None:
    assert rig.is_at_pose(rig.probe, rig.truth), np.round(rig.probe.joint_angles(), 2)


def live(dice: random.Random) -> FaultCase:
    """Return a row: the load of a free arm changes, and again while the wearer acts."""
    free, held, meanwhile = some_change(dice), some_change(dice), dice.uniform(0.1, 2.0)
    act, steps = dice.choice(list(ACTS.items()))
    lasts = sum(step.get("over") or step["hold"] for step in [*steps, BACK[0]])
    happen = in_turn(
        *(load(free), pause(dice.uniform(0.5, 5.0)), wearer([*steps, *BACK]), pause(meanwhile), load(held)),
        *(pause(max(0.0, lasts - meanwhile)), load({}), pause(2.0)),
        lambda rig: rig.run_until(lambda: rig.probe.diagnostic("compensator", "changing load") == "none", 30.0),
        *(wearer([{"hold": 60.0}]), pause(1.5)),
    )
    given: dict[str, Any] = {"outcomes": ("active",), "check": not_driven}
    name = f"{free}, {act}, {held}"
    return FaultCase(name, happen, SOAK, None, afterwards=is_carried_where_the_wearer_let_go, speed_limit=99.0, **given)


def error(code: int) -> Action:
    """Let the motor that is struck report an error, or 0 for none."""
    return lambda rig: rig.set("simulator", {"fault.error": [0, code, 0, 0]})


FAULTS = (  # after which the same nodes run on
    *(replace(case, arm=SOAK, limit=None, outcomes=()) for case in MESSAGES),
    FaultCase("arm disabled", lambda rig: rig.probe.enable(False), SOAK, None, outcomes=("disabled",)),
    FaultCase("motor 2 reports an error", error(AK_ERROR), SOAK, None, clear=error(0), outcomes=("motor_error",)),
    FaultCase("compensator frozen", send(STOP, "compensator"), SOAK, None, clear=send(CONTINUE, "compensator"),
        outcomes=("command_stale",)),
)  # fmt: skip


def lost_in(folder: Path, is_last: bool) -> list[str]:
    """Return what the recording in `folder` lacks. An earlier one ends where a node has ended."""
    bag = read_bag(folder / "bag")
    notes = [*bag.notes, *bag.problems]
    lost = [note for note in notes if "lost" in note or "cut short" in note or (is_last and bag.is_partial)]
    gaps = {arm.name: float(np.diff(arm.time).max()) for arm in bag.recordings}
    return lost + [f"no joint states of {name} for {gap:.1f} s" for name, gap in gaps.items() if gap > MAX_GAP]


def soak(minutes: float, dice: random.Random, pool: Pool) -> list[str]:
    """Play rows for so many minutes, or until one is unsafe; return what failed."""
    failed, sizes, end = list[str](), dict[SoakRig, list[list[float]]](), time.monotonic() + 60.0 * minutes
    while time.monotonic() < end and not failed:
        for case in (live(dice), *dice.sample(FAULTS, dice.randrange(2))):
            played = pool.play(case)
            failed += [f"{case.name}: {played.unsafe}"] * bool(played.unsafe)
            print(
                f"{case.name}: {played.outcome}, {played.unsafe or 'safe'}", *pool.log * bool(played.unsafe), sep="\n "
            )
        if isinstance(pool.rig, SoakRig) and not pool.rig.have_ended:
            sizes.setdefault(pool.rig, []).append(pool.rig.memory())
    pool.end()
    for measured in sizes.values():
        growth = np.subtract(measured[-1], measured[min(WARM_UP, len(measured) - 1)])
        print("memory grew by", dict(zip(NODES, growth.round(1).tolist(), strict=True)), "MB")
        failed += [f"memory of {node}: +{mb:.1f} MB" for node, mb in zip(NODES, growth, strict=True) if mb > MAX_GROWTH]
    return failed + [line for folder in pool.folders for line in lost_in(folder, folder is pool.folders[-1])]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m test.faults.soak", description="Strike both arms for an hour.")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with pool_of(SoakRig) as rigs:
        found = soak(options.minutes, random.Random(options.seed), rigs)
    print("failed:", *(found or ["nothing"]), sep="\n ")
    sys.exit(bool(found))
