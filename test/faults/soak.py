"""python -m test.faults.soak [--minutes 60] [--seed 1]: both arms, live changes, an active wearer, harmless faults.

Each minute the operator changes the right arm's load at random, while it is free and while its wearer reaches, shakes,
throws, pushes or holds it; in every second minute, by chance, a fault strikes it, judged as in the fault matrix. The
arm must be carried again each time. The left arm is carried beside it, and a recorder runs throughout.

The exit code is 1 if a fault was unsafe, the motors caused more than MOVED, an arm was let down without a cause or not
carried again, a change was refused, the recording has losses or ends early, or a node's memory grew by more than
MAX_GROWTH. It is a cause that the computer stood still for STALL, or that its processors were idle for less than IDLE.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100 + 1))  # before rclpy is imported

import numpy as np
from geometry_msgs.msg import Vector3Stamped
from rich.console import Console
from sensor_msgs.msg import JointState

from exo_gravity.bag.reader import read_bag
from exo_gravity.core.motors.specs import EXIT

from .actions import enable, in_turn, pause, publish, send_signal, states_at, tilt
from .cases import CONTINUE, EFFORTS, STATES, STOP, TILT
from .device_faults import END_SILENCE, ERROR, NO_ERROR, SILENCE
from .fault_case import ALL_JOINTS, PROCESS_REACTION, FaultCase
from .frames import foreign_frames
from .live_arm import MINUTE, NODES, LiveArm, SoakRig
from .runner import Result, RigPool
from .stall_clock import StallClock
from .wearer_cases import MOVED

WARM_UP = 5  # min until memory counts: caches and buffers fill
MAX_GROWTH = 5.0  # MB, from then until the end
MAX_GAP = 1.0  # s between two recorded joint states of an arm
LIVE, LIVE_BEFORE_FAULT = 45.0, 15.0  # s of a minute after which no further change and act begin


# fmt: off
FAULTS = (
    FaultCase("arm disabled", enable(False), SoakRig),
    FaultCase("NaN joint states", publish(JointState, STATES, states_at([math.nan] * 4)), SoakRig, None),
    FaultCase("NaN tilt", publish(Vector3Stamped, TILT, tilt(math.nan)), SoakRig, None),
    FaultCase("second publisher of efforts", publish(JointState, EFFORTS, lambda rig: rig.probe.effort_commands[-1]),
        SoakRig),
    FaultCase("foreign EXIT to motor 2, once", foreign_frames(EXIT), SoakRig, steps_from=0.05),
    FaultCase("bus silent for 1 s", in_turn(SILENCE, pause(1.0), END_SILENCE), SoakRig, unreached=ALL_JOINTS),
    FaultCase("motor 2 reports an error", ERROR, SoakRig, clear=NO_ERROR),
    FaultCase("compensator frozen", send_signal("compensator", STOP), SoakRig, PROCESS_REACTION,
        clear=send_signal("compensator", CONTINUE)),
)
# fmt: on


class Soak:
    """The soak. results: of the faults. memory: (minutes, nodes) MB."""

    def __init__(self, seed: int, console: Console) -> None:
        self._dice, self._console = random.Random(seed), console
        self.live = LiveArm(self._dice)
        self.results: list[Result] = []
        self.memory: list[list[float]] = []

    @property
    def fastest(self) -> float:
        """The largest speed in rad/s that the motors caused."""
        return max(self.live.fastest, *(result["driven_rad_s"] or 0.0 for result in self.results), 0.0)

    def run(self, minutes: float, folder: Path) -> Path:
        """Run it, to the end or until a fault was unsafe; return the recording."""
        with contextlib.closing(StallClock()) as clock, RigPool(folder, shipped_timeouts=False) as pool:
            rig = pool.rig_for(SoakRig)
            assert isinstance(rig, SoakRig)
            rig.bring_to("active")
            start = time.monotonic()
            for minute in range(round(minutes)):
                try:
                    self._run_minute(minute, start + minute * MINUTE, rig, pool, clock)
                except AssertionError as error:  # also a Timeout
                    self.live.trouble.append(f"{self.live.last}: {error}")
                    self._console.print(self.live.trouble[-1], markup=False, soft_wrap=True)
                    break
                if pool.rig is not rig:  # it has ended with what was unsafe
                    break
                self.memory.append(rig.memory())
                rig.forget()
                rig.wait(start + (minute + 1) * MINUTE - time.monotonic())
        return folder / "1" / "bag"

    def _run_minute(self, minute: int, start: float, rig: SoakRig, pool: RigPool, clock: StallClock) -> None:
        live, fault = self.live, self._dice.choice(FAULTS) if self._dice.random() < 0.5 else None
        seen, news = live.seen.copy(), (len(live.trouble), len(live.stalls))
        live.live(rig, start + (LIVE_BEFORE_FAULT if fault else LIVE), clock)
        parts = [f"{what} {count}" for what, count in (live.seen - seen).items()]
        lines = [*live.trouble[news[0] :], *live.stalls[news[1] :]]
        if fault:
            result = pool.run(fault)
            self.results.append(result)
            parts.append(f"{fault.name}: {result['result']}, {result['unsafe'] or 'safe'}")
            lines += result.pop("log", ())
            if pool.rig is rig:
                rig.bring_to("active")
        print_ = self._console.print
        print_(f"{minute + 1:3d} {', '.join(parts)}; at most {self.fastest:.2f} rad/s", markup=False, soft_wrap=True)
        for line in lines:
            print_("     ", line, markup=False, soft_wrap=True)


def find_failures(soak: Soak, recording: Path) -> dict[str, Any]:
    """Return what failed, by subject."""
    failed: dict[str, Any] = {r["fault"]: r["unsafe"] for r in soak.results if r["unsafe"]}
    if soak.live.trouble:
        failed["without a cause"] = soak.live.trouble
    if soak.fastest > MOVED:
        failed["moved by the motors"] = f"{soak.fastest:.2f} rad/s"
    if len(soak.memory) > WARM_UP:
        growth = np.subtract(soak.memory[-1], soak.memory[WARM_UP])
        failed |= {
            f"memory of {node}": f"+{mb:.1f} MB" for node, mb in zip(NODES, growth, strict=True) if mb > MAX_GROWTH
        }
    bag = read_bag(recording)
    losses = [note for note in (*bag.notes, *bag.problems) if "lost" in note]
    if bag.is_partial or losses:
        failed["recording"] = [*bag.notes, *bag.problems]
    for arm in bag.recordings:
        if (gap := float(np.diff(arm.time).max())) > MAX_GAP:
            failed[f"recording of {arm.name}"] = f"no joint states for {gap:.1f} s"
    return failed


def main() -> int:
    """Run the soak; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m test.faults.soak", description="Strike both arms for an hour.")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, default=Path("build/soak.json"), metavar="FILE", help="(%(default)s)")
    options = parser.parse_args()
    console = Console(width=150, highlight=False)
    soak = Soak(options.seed, console)
    with tempfile.TemporaryDirectory() as folder:
        recording = soak.run(options.minutes, Path(folder))
        failed = find_failures(soak, recording)
    for node, *sizes in zip(NODES, *soak.memory, strict=True) if soak.memory else ():
        console.print(f"{node}: {min(sizes[WARM_UP:] or sizes):.1f} MB after the start, {sizes[-1]:.1f} MB at the end")
    seen = {**soak.live.seen, "faults": len(soak.results), "while the computer stood still": len(soak.live.stalls)}
    report = {"seen": seen, "fastest": soak.fastest, "results": soak.results, "memory": soak.memory, "failed": failed}
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(report, indent=1) + "\n")
    console.print("; ".join(f"{what}: {count}" for what, count in seen.items()), markup=False)
    console.print(f"the motors caused at most {soak.fastest:.2f} rad/s; failed: {failed or 'nothing'}", markup=False)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
