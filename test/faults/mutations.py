"""`make mutations`: does the fault matrix see a defect? Each of these defects must turn a row unsafe.

    python -m test.faults.mutations [--only TEXT ...]

Each defect is applied to a copy of the package, with which the rows that are meant to see it are played. The exit code
is 1 if a defect is not seen, or its text is no longer in the source.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from ..support import ROOT

COPIED = ("exo_gravity", "test", "config")
ROW_LIMIT = 240.0  # s for each row, with the start of its nodes
SAFETY, DESCENT, LIMITS = (f"exo_gravity/core/safety/{name}.py" for name in ("machine", "descent", "limits"))
GUIDANCE = "exo_gravity/core/compensation/guidance.py"
MONITOR = "exo_gravity/core/safety/motion_monitor.py"
ASSIST = "exo_gravity/core/compensation/terms/assist.py"
LEASE = "exo_gravity/core/safety/lease.py"
BUS_LOCK, WATCHDOG = "exo_gravity/hardware/ownership/bus_lock.py", "exo_gravity/hardware/ownership/watchdog.py"


class Edit(NamedTuple):
    """One change: in `file`, the text `old`, which occurs once, becomes `new`."""

    file: str
    old: str
    new: str


class Mutation(NamedTuple):
    """A deliberate defect, and the names of the rows of which at least one must see it."""

    name: str
    rows: tuple[str, ...]
    edits: tuple[Edit, ...]


MUTATIONS = (
    Mutation(
        "damping on one motor only",
        ("motor 2 reports an error",),
        (
            Edit(
                DESCENT,
                "tuple(joint.damping for joint in self._joints)",
                "(self._joints[0].damping, 0.0, 0.0, 0.0)",
            ),
        ),
    ),
    Mutation(
        "EXIT at once on a fault",
        ("motor 2 reports an error",),
        (
            Edit(
                SAFETY,
                "        elif self.state is not State.LETTING_DOWN:\n            self._let_down(now)",
                "        elif self.state is not State.LETTING_DOWN:\n            self._enter(State.FAULT, now)",
            ),
        ),
    ),
    Mutation(
        "the torque does not fade",
        ("motor 2 reports an error",),
        (
            Edit(
                DESCENT,
                "self.restart(effort, damping)",
                "self.restart(0.0, damping)",
            ),
        ),
    ),
    Mutation(
        "the watchdog never acts",
        ("can_bridge killed",),
        (Edit(WATCHDOG, "    if not notes.drive.powered:\n", "    if True:\n"),),
    ),
    Mutation(
        "a motor that was switched off is not switched on again",
        ("foreign EXIT to motor 2 while let down", "motor 2 restarts in 30 ms"),
        (Edit(SAFETY, "missing and not is_unsure for missing", "False for missing"),),
    ),
    Mutation(
        "a second bridge takes the bus",
        ("second can_bridge on the bus",),
        (
            Edit(BUS_LOCK, "lock.bind(name)", 'lock.bind("")'),  # the kernel chooses a free name
            Edit("exo_gravity/hardware/ownership/owned_bus.py", "bus.listen()", "pass"),
        ),
    ),
    Mutation(
        "a soft wall without damping",
        ("elbow pushed into the soft wall",),
        (Edit(LIMITS, "damping.append(WALL_DAMPING * min(", "damping.append(0.0 * min("),),
    ),
    Mutation(
        "torque delivery is not checked",
        ("motor 2 restarts in 30 ms",),
        (Edit(SAFETY, "if fault and self.state in CARRYING and is_proven:", "if False:"),),
    ),
    Mutation(
        "a second commander is ignored",
        ("second publisher of efforts",),
        (Edit("exo_gravity/nodes/can_bridge/effort_exchange.py", "if self._commander.is_another(info):", "if False:"),),
    ),
    Mutation(
        "stale efforts are accepted",
        ("compensator frozen, the rest runs on",),
        (Edit(SAFETY, "elif fault is None:", "elif False:"),),
    ),
    Mutation(
        "zeros once checked are always trusted",
        ("joint 2 jumps by a motor turn, then clear and enable",),
        (Edit(SAFETY, "if readings.lost or (readings.fault and readings.fault.code is FaultCode.POSITION_JUMP):",
              "if False:"),
         Edit(SAFETY, "        if code.needs_recheck:\n", "        if False:\n")),
    ),
    Mutation(
        "motors are switched off while damping still holds the arm",
        ("arm disabled",),
        (
            Edit(
                DESCENT,
                "return self.effort == 0.0 and self.damping <= FREE_DAMPING",
                "return self.effort == 0.0",
            ),
            Edit(DESCENT, "free >= REST_TIME and now - rest_since >= REST_TIME", "free >= 0.0"),
        ),
    ),
    Mutation(
        "the last effort of an outer loop that ended stays",
        ("outer loop killed",),
        (Edit(ASSIST, "elif now - self._stamp > self.valid:", "elif self._stamp == -math.inf:"),),
    ),
    Mutation(
        "a ride that never ends",
        ("compensator frozen, the rest runs on",),
        (Edit("exo_gravity/core/safety/monitors.py", "if self._left >= 0.0 and age <= LONGEST_AGE:", "if True:"),),
    ),
    Mutation(
        "a ride without damping",
        ("compensator stopped for 0.1 s",),
        (Edit(SAFETY, "(DAMPING,) * len(guided) if self.ride.is_riding else guided", "guided"),),
    ),
    Mutation(
        "a motor that replies no torque is taken for sound",
        ("motor 2 restarts in 30 ms",),
        (Edit("exo_gravity/core/safety/delivery.py", "excess = abs(joint.effort - nearest) -",
              "excess = (abs(joint.effort) > 0.1) * abs(joint.effort - nearest) -"),),
    ),
    Mutation(
        "a change of load that ignores the joint's speed",
        ("Zero-G to One-G, 75 kg", "body mass 75 to 100"),
        (Edit(GUIDANCE, "driven = -math.copysign(speed, way * speed)", "driven = 0.0"),),
    ),
    Mutation(
        "a clamp outside the guided change",
        ("max_effort 9 to 0.5 Nm, Zero-G, 75 kg",),
        (Edit("exo_gravity/core/compensation/compensator.py", "zip(torque, self._effort, strict=True)",
              "zip(clamped(torque, s.max_effort), self._effort, strict=True)"),),
    ),
    Mutation(
        "the torque of an outer loop that has ended is remembered",
        ("outer loop killed, the next one asks for 0 Nm",),
        (
            Edit(
                ASSIST,
                "self._torque = tuple([left * last for last in self._torque])",
                "return tuple([left * last for last in self._torque])",
            ),
        ),
    ),
    Mutation(
        "control that is not renewed is not lost",
        ("who holds control killed",),
        (Edit(LEASE, "if not self.holder or now - self._renewed <= LEASE_TIME:", "if True:"),),
    ),
    Mutation(
        "the lock of a bus depends on the user's folder",
        ("can_bridge of another session on the bus",),
        (
            Edit(BUS_LOCK, 'NAME = "\\0exo_gravity/"', 'NAME = "\\0" + os.environ.get("XDG_RUNTIME_DIR", "")[-20:]'),
            Edit("exo_gravity/hardware/ownership/owned_bus.py", "bus.listen()", "pass"),
        ),
    ),
    Mutation(
        "the watchdog of silent motors never hands the bus over",
        ("motors silent for long, then the next can_bridge",),
        (Edit(WATCHDOG, "let_down(arm, notes, log, is_wanted)", "let_down(arm, notes, log, lambda: False)"),),
    ),
    Mutation(
        "the brake of the descent grows without a bound",
        ("compensator frozen while the wearer presses it down from the horizontal",),
        (Edit(DESCENT, "self._most = max(self._most, abs(effort))", "self._most = 18.0"),
         Edit(DESCENT, "rate = min(BRAKE_GROWTH, BRAKE_GAIN * excess)", "rate = BRAKE_GAIN * excess")),
    ),
    Mutation(
        "the descent drives a joint that the wearer pushed down",
        ("compensator frozen while the wearer presses it down from the horizontal",),
        (Edit(DESCENT, "if self.effort * velocity > 0.0 and speed > DRIVEN_SPEED:", "if False:"),),
    ),
    Mutation(
        "powered frames are sent while the supply is cut",
        ("V3 boards: supply cut for 2 s", "supply cut for 2 s"),
        (Edit(SAFETY, "if all(readings.silent) and sent.powered:", "if False:"),),
    ),
    Mutation(
        "an enable never expires",
        ("enabled, and the supply cut for 4 s while checking",),
        (Edit(SAFETY, "elif self._now - self._since >= limits.enable_timeout:", "elif False:"),),
    ),
    Mutation(
        "unexplained torque is never a fault",
        ("effort of joint 2 with the wrong sign", "efforts oscillate at 8 Hz"),
        (Edit(MONITOR, "if not self.impulse[i] <= PATIENCE * full and fault is None:", "if False:"),),
    ),
    Mutation(
        "unexplained torque is passed on, and takes ten times as long",
        ("effort of joint 2 with the wrong sign",),
        (Edit(MONITOR, "passed.append(within)", "passed.append(torque)"),
         Edit(MONITOR, "PATIENCE = 0.012 ", "PATIENCE = 0.15 ")),
    ),
)  # fmt: skip


def apply(mutation: Mutation, root: Path) -> None:
    """Change the copy of the checkout in `root`. Raises ValueError if a text does not occur exactly once."""
    for edit in mutation.edits:
        path = root / edit.file
        source = path.read_text()
        if source.count(edit.old) != 1:
            raise ValueError(f"{edit.file}: the text to change occurs {source.count(edit.old)} times: {edit.old!r}")
        path.write_text(source.replace(edit.old, edit.new))


def unsafe_rows(mutation: Mutation, folder: Path) -> dict[str, str]:
    """Play the rows of `mutation` in `folder`; return what was unsafe by row. Raises ValueError if no row could run."""
    for name in COPIED:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "data"))
    apply(mutation, folder)
    output = folder / "faults.json"
    names = ("--exactly", "--only", *mutation.rows, "--output", str(output))
    subprocess.run(
        [sys.executable, "-m", "test.faults.run", *names],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        stdout=subprocess.DEVNULL,
        timeout=ROW_LIMIT * len(mutation.rows),
        check=False,
    )
    results = json.loads(output.read_text())
    played = [row for row in results if row["result"] != "not run"]
    if not played:
        raise ValueError(f"no row could run: {results}")
    return {row["fault"]: row["unsafe"] for row in played if row["unsafe"]}


def main() -> int:
    """Try each mutation; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m test.faults.mutations", description="Try deliberate defects.")
    parser.add_argument("--only", default=[""], nargs="+", metavar="TEXT", help="only defects whose name contains TEXT")
    arguments = parser.parse_args()
    unseen = 0
    for mutation in MUTATIONS:
        if not any(text in mutation.name for text in arguments.only):
            continue
        with tempfile.TemporaryDirectory() as folder:
            try:
                unsafe = unsafe_rows(mutation, Path(folder))
            except (ValueError, FileNotFoundError, subprocess.TimeoutExpired) as error:
                unsafe, reason = {}, str(error)
            else:
                reason = f"not seen by: {', '.join(mutation.rows)}"
        seen = "; ".join(f"{row}: {failure}" for row, failure in unsafe.items())
        print(f"{mutation.name}: {seen or f'NOT SEEN ({reason})'}", flush=True)
        unseen += not seen
    print(f"{unseen} defects not seen" if unseen else "every defect was seen")
    return int(bool(unseen))


if __name__ == "__main__":
    sys.exit(main())
