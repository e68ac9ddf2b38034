# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""One row of the table: an arm on two computers, carried and let go over one wire."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ..support.launched_nodes import REAL, Parameters
from .arm import MOVE, PEERS, TwoComputers, write_parameters
from .measure import Measured, measure
from .network import Network, Wire

START_TIMEOUT = 25.0  # s until the arm is carried


@dataclass(frozen=True)
class Result:
    """start: s from the start of the nodes until the arm was carried, None if it never was.

    outcome: 'carried', or why the arm was not carried to the end of the hold.
    measured: None without a hold.
    late_cycles: of the bridge, that began more than a period late; late_frame: ms by which a frame was late beyond the
    wire's delay. Both show how busy this computer was.
    """

    wire: Wire
    start: float | None
    outcome: str
    measured: Measured | None
    late_cycles: int
    late_frame: float


def play(
    wire: Wire,
    folder: Path,
    hold: float,
    timing: Mapping[str, Parameters] = REAL,
    peers: Mapping[str, str] = PEERS,
) -> Result:
    """Play one case; the files stay in `folder`. hold: s for which the wearer lets go."""
    params = write_parameters(folder, hold, timing)
    began = time.monotonic()
    with Network(wire) as network, TwoComputers(network, params, peers) as arm:
        carried = released = ended = None
        if arm.wait_until(lambda: _has_decided(arm), START_TIMEOUT) and arm.bridge["state"] == "active":
            carried = time.monotonic() - began
            if _wait_for(arm, "hold", MOVE + 10.0):
                released = arm.lines[-1][0]
                _wait_for(arm, "done", hold + 10.0)
                ended = arm.lines[-1][0]
        outcome = "carried" if arm.action == "done" else _reason(arm)
        late = int(arm.bridge.get("late cycles", 0))
        arm.stop()
        (folder / "log.txt").write_text("\n".join(f"{name}: {line}" for name in arm.log for line in arm.log[name]))
    measured = None
    if released is not None and ended is not None:
        truth = next(folder.glob("truth*.bin"))
        measured = measure(folder / "bag_robot", truth, released, ended)
    return Result(wire, carried, outcome, measured, late, network.traffic["latest"])


def _has_decided(arm: TwoComputers) -> bool:
    """Return whether the bridge carries the arm, has a fault, or has refused the start."""
    return arm.bridge.get("state") in ("active", "fault") or arm.bridge.get("refusal", "none") != "none"


def _wait_for(arm: TwoComputers, action: str, timeout: float) -> bool:
    """Wait until the virtual wearer is at `action`; return whether it is, and the bridge has no fault."""

    def has_fault() -> bool:
        return bool(arm.bridge.get("fault", "none") != "none")

    arm.wait_until(lambda: arm.action in (action, "done") or has_fault(), timeout)
    return arm.action == action and not has_fault()


def _reason(arm: TwoComputers) -> str:
    fault = arm.bridge.get("fault", "none")
    return str(arm.bridge.get("message", "no report of the bridge") if fault == "none" else f"let down: {fault}")
