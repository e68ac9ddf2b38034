# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What happens in each minute of the soak: the operator changes the load of an arm, and its wearer acts, at random."""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import yaml

from exo_gravity.core.safety.limits import READING
from exo_gravity.sim.judge import measure

from ..support import CONFIG
from ..support.launched_nodes import CALM, LaunchedNodes, Parameters
from .actions import Steps, compensator, wearer
from .rigs import BothArmsRig
from .stall_clock import StallClock
from .virtual_cases import KEEP, MOVED, PUSH_DOWN, RATED, ROBOT, SHAKE, THROW, WORN, WORN_COG, WORN_MASS

MINUTE = 60.0  # s
STALL = READING.reply_timeout  # s
IDLE = 0.03  # share
NODES = (
    "/imu",
    "/recorder",
    *(f"/{side}/{node}" for side in ("right", "left") for node in ("can_bridge", "compensator")),
)


class SoakRig(BothArmsRig):
    """Both arms carry the arm of a 75 kg wearer, and a recorder runs."""

    rate = 50.0
    pose = WORN.pose
    compensator: ClassVar[Parameters] = {"mode": "zero_g", "support": 1.0, "wearer": {"body_mass": 75.0}}
    simulator: ClassVar[Parameters] = {"wearer": {"mass": WORN_MASS.tolist(), "cog": WORN_COG.tolist()}}

    def __init__(self, folder: Path, shipped_timeouts: bool = True) -> None:
        content = yaml.safe_load((CONFIG / "sim_both.yaml").read_text())
        content["/recorder"] = {"ros__parameters": {"output": str(folder / "bag")}}
        self.base = str(folder / "soak.yaml")
        Path(self.base).write_text(yaml.safe_dump(content))
        super().__init__(folder, shipped_timeouts)

    @property
    def timing(self) -> Mapping[str, Parameters]:
        """Rates at which an ordinary computer has time left."""
        return CALM

    def _device_nodes(self) -> LaunchedNodes:
        without = ("can_bridge", "compensator", "imu", "recorder")
        return self._nodes(without=without, truth=True, simulator=self.simulator)

    def wait(self, seconds: float) -> None:
        """Receive messages for this time."""
        end = time.monotonic() + seconds
        self.probe.wait_until(lambda: time.monotonic() > end, 2 * MINUTE)

    def forget(self) -> None:
        """Drop the messages received so far."""
        for probe in (self.probe, self.left):
            for messages in (probe.joint_states, probe.effort_commands, probe.states):
                del messages[:-1]

    def memory(self) -> list[float]:
        """Return the resident memory of each of NODES in MB."""
        return [resident(self.process(node).pid) for node in NODES]


CARRIED: dict[str, Any] = {
    "mode": "zero_g",
    "support": 1.0,
    "wearer.body_mass": 75.0,
    "robot.mass": list(ROBOT.mass),
    **RATED,
}
BACK: Steps = [{"move": list(SoakRig.pose), "over": over} for over in (1.5, 60.0)]  # where the wearer carries their arm
# As the virtual wearer's 25 Nm permit while the motors do not carry them.
ACTS: dict[str, Steps] = {
    "lifts": [{"move": [0.0, 1.0, 0.3, 1.0], "over": 1.6}],
    "pushes down": PUSH_DOWN,
    "holds": KEEP,
    "shakes": SHAKE,
    "throws": [*THROW, {"hold": 0.5}],
    "reaches": [{"move": pose, "over": 1.0} for pose in ([0.3, 0.9, 0.6, 1.0], list(SoakRig.pose)) * 3],
}


class LiveArm:
    """An operator who changes the load of the right arm, and a wearer who acts. Both do so by `dice`.

    seen: how often each thing happened. trouble: what must not happen. stalls: what happened while the computer stood
    still. fastest: rad/s that the motors caused. stall: s for which the computer stood still during the last act. last:
    change, act, and change meanwhile.
    """

    def __init__(self, dice: random.Random) -> None:
        self._dice = dice
        self.seen: Counter[str] = Counter()
        self.trouble: list[str] = []
        self.stalls: list[str] = []
        self.fastest = 0.0
        self.stall = 0.0
        self.last = ""

    def live(self, rig: SoakRig, end: float, clock: StallClock) -> None:
        """Let them do so until `end` (monotonic s) or until a node has ended, and judge each change and act."""
        while time.monotonic() < end and not rig.has_lost_a_node:
            rig.bring_to("active")
            arms = (("right", rig.probe, rig.truth), ("left", rig.left, rig.left_truth))
            states, lines, start = [len(probe.states) for _, probe, _ in arms], len(rig.nodes[0].log), time.time()
            clock.longest_gap()
            idle, total = processor_time()
            try:
                found = self._act(rig)
            except AssertionError as error:  # also a Timeout: an arm that was let down ends its change of load
                found = [str(error).splitlines()[0]]
            self.stall, (idle_now, total_now) = clock.longest_gap(), processor_time()
            idle = (idle_now - idle) / (total_now - total)
            for (arm, probe, truth), known in zip(arms, states, strict=True):
                response = measure(truth.since(start), start, 1.0 / rig.rate)
                if others := [str(state) for state in probe.states[known:] if state != "active"]:
                    log = [line for line in rig.nodes[0].log[lines:] if f"{arm}/can_bridge" in line]
                    found.append("\n      ".join([f"{arm} arm let down: {', '.join(dict.fromkeys(others))}", *log]))
                    continue
                self.fastest = max(self.fastest, response.driven)
                if response.driven > MOVED:
                    found.append(f"{arm} arm driven at {response.driven:.2f} rad/s")
                if response.excess > 0.0:
                    found.append(f"{arm} arm: torque step of {response.largest_step:.2f} Nm")
            found = [f"{self.last}: {what}" for what in found]
            if self.stall > STALL or idle < IDLE:
                why = f"the computer stood still for {self.stall:.3f} s, and was idle {idle:.0%} of the time"
                self.stalls += [f"{why}: {what}" for what in found]
            else:
                self.trouble += found

    def _act(self, rig: SoakRig) -> list[str]:
        """Change the load of a free arm, and again while the wearer acts; return what is wrong afterwards."""
        free, held = self._some_change(), self._some_change()
        self._set_load(rig, free)
        rig.wait(self._dice.uniform(0.5, 5.0))
        act, steps = self._dice.choice(list(ACTS.items()))
        self.last = f"{free}, {act}, {held}"
        wearer(rig, [*steps, *BACK])
        self.seen[act] += 1
        meanwhile = self._dice.uniform(0.1, 2.0)
        rig.wait(meanwhile)
        self._set_load(rig, held)
        rig.wait(sum(step.get("over") or step["hold"] for step in [*steps, BACK[0]]) - meanwhile)
        self._set_load(rig, {})
        rig.wait(2.0)
        probe = rig.probe
        probe.wait_until(lambda: probe.state != "active" or probe.diagnostic("compensator", "changing load") == "none")
        wearer(rig, [{"hold": 60.0}])
        rig.wait(1.5)
        if not rig.is_at_pose():
            return [f"not carried where the wearer let go: {np.round(rig.probe.joint_angles(), 2)}"]
        self.seen["carried again"] += 1
        return []

    def _some_change(self) -> dict[str, Any]:
        """Return in what the load differs from CARRIED."""
        dice, (*links, last) = self._dice, CARRIED["robot.mass"]
        changes: tuple[dict[str, Any], ...] = (
            {"mode": "one_g"},
            {"support": round(dice.random(), 2)},
            {"wearer.body_mass": round(dice.uniform(50.0, 100.0), 1)},
            {"robot.mass": [*links, round(last + dice.uniform(0.0, 1.0), 2)]},  # a payload
            {"max_effort": [round(dice.uniform(0.2, 1.0) * most, 2) for most in RATED["max_effort"]]},
        )
        return dice.choice(changes)

    def _set_load(self, rig: SoakRig, change: dict[str, Any]) -> None:
        compensator({**CARRIED, **change})(rig)
        self.seen["changes"] += 1


def resident(pid: int) -> float:
    """Return the resident memory of a process in MB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1e3


def processor_time() -> tuple[float, float]:
    """Return for how long the processors were idle or had a process of low priority, and their whole time, in ticks."""
    ticks = [int(field) for field in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
    return ticks[1] + ticks[3] + ticks[4], sum(ticks)
