"""python -m test.faults.soak [--minutes 60] [--seed 1]: both arms in Zero-G, with a harmless fault each minute.

The right arm is struck at random, judged as in the fault matrix, and must be carried again each time; a recorder runs
throughout. The exit code is 1 if a fault was unsafe, an arm was not carried again, the recording has losses or ends
early, or a node's memory grew by more than MAX_GROWTH.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100 + 1))  # before rclpy is imported

import numpy as np
import yaml
from geometry_msgs.msg import Vector3Stamped
from rich.console import Console
from sensor_msgs.msg import JointState

from exo_gravity.bag.reader import read_bag
from exo_gravity.core.motors.specs import EXIT

from ..support import CONFIG
from ..support.launched_nodes import LaunchedNodes, Parameters
from .actions import enable, in_turn, pause, publish, send_signal, states_at, tilt
from .cases import CONTINUE, EFFORTS, STATES, STOP, TILT
from .device_faults import END_SILENCE, ERROR, NO_ERROR, SILENCE
from .fault_case import ALL_JOINTS, PROCESS_REACTION, FaultCase
from .frames import foreign_frames
from .rigs import BothArmsRig, WearerRig
from .runner import Result, RigPool

MINUTE = 60.0  # s
WARM_UP = 5  # min until memory counts: caches and buffers fill
MAX_GROWTH = 5.0  # MB, from then until the end
MAX_GAP = 1.0  # s between two recorded joint states of an arm
NODES = (
    "/imu",
    "/recorder",
    *(f"/{side}/{node}" for side in ("right", "left") for node in ("can_bridge", "compensator")),
)


class SoakRig(BothArmsRig):
    """Both arms carry the passive arm of a 75 kg wearer, and a recorder runs."""

    pose = WearerRig.pose
    compensator: ClassVar[Parameters] = WearerRig.compensator
    simulator: ClassVar[Parameters] = {"wearer": WearerRig.simulator["wearer"]}

    def __init__(self, folder: Path, shipped_timeouts: bool = True) -> None:
        content = yaml.safe_load((CONFIG / "sim_both.yaml").read_text())
        content["/recorder"] = {"ros__parameters": {"output": str(folder / "bag")}}
        self.base = str(folder / "soak.yaml")
        Path(self.base).write_text(yaml.safe_dump(content))
        super().__init__(folder, shipped_timeouts)

    def _device_nodes(self) -> LaunchedNodes:
        without = ("can_bridge", "compensator", "imu", "recorder")
        return self._nodes(without=without, truth=True, simulator=self.simulator)

    def wait_until(self, end: float) -> None:
        """Receive messages until `end` (monotonic s)."""
        self.probe.wait_until(lambda: time.monotonic() > end, 2 * MINUTE)

    def memory(self) -> list[float]:
        """Return the resident memory of each of NODES in MB."""
        return [resident(self.process(node).pid) for node in NODES]


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


def resident(pid: int) -> float:
    """Return the resident memory of a process in MB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1e3


def strike(minutes: float, seed: int, folder: Path, console: Console) -> tuple[list[Result], list[list[float]], Path]:
    """Run the soak; return the results, the memory (minutes, nodes) in MB, and the recording."""
    dice, results, memory = random.Random(seed), [], []
    with RigPool(folder, shipped_timeouts=False) as pool:
        start = time.monotonic()
        for minute in range(round(minutes)):
            result = pool.run(dice.choice(FAULTS))
            results.append(result)
            console.print(minute + 1, result["fault"], result["result"], result["unsafe"] or "safe", markup=False)
            if result["unsafe"]:
                for line in result.pop("log", ()):
                    console.print("    ", line, markup=False)
                break
            assert isinstance(pool.rig, SoakRig)
            memory.append(pool.rig.memory())
            pool.rig.wait_until(start + (minute + 1) * MINUTE)
        if isinstance(pool.rig, SoakRig):
            pool.rig.bring_to("active")
    return results, memory, folder / "1" / "bag"


def find_failures(results: Sequence[Result], memory: Sequence[Sequence[float]], recording: Path) -> dict[str, Any]:
    """Return what failed, by subject."""
    failed: dict[str, Any] = {r["fault"]: r["unsafe"] for r in results if r["unsafe"]}
    if len(memory) > WARM_UP:
        growth = np.subtract(memory[-1], memory[WARM_UP])
        failed |= {
            f"memory of {node}": f"+{mb:.1f} MB" for node, mb in zip(NODES, growth, strict=True) if mb > MAX_GROWTH
        }
    bag = read_bag(recording)
    losses = [note for note in (*bag.notes, *bag.problems) if "lost" in note]
    if bag.is_partial or losses:
        failed["recording"] = losses or "it ends early"
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
    with tempfile.TemporaryDirectory() as folder:
        results, memory, recording = strike(options.minutes, options.seed, Path(folder), console)
        failed = find_failures(results, memory, recording) if memory else results[0]
    for node, *sizes in zip(NODES, *memory, strict=True) if memory else ():
        console.print(
            f"{node}: {min(sizes[WARM_UP:], default=0.0):.1f} MB after the start, {sizes[-1]:.1f} MB at the end"
        )
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps({"results": results, "memory": memory, "failed": failed}, indent=1) + "\n")
    console.print(f"{len(results)} faults; failed: {failed or 'nothing'}", markup=False)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
