# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A process that carries an arm as a bridge does; `python -m test.hardware.carrier FILE`, FILE a pickled arm.

It prints the PID of its watchdog once the motors are on and the watchdog runs.
"""

from __future__ import annotations

import os
import pickle
import sys
import time
from pathlib import Path

from exo_gravity.core.errors import BusError
from exo_gravity.core.safety.drive import Drive
from exo_gravity.hardware.can.can_port import ArmOnBus
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.ownership.owned_bus import OwnedBus

from ..support.simulated_device import drive_of


def log(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def main(arm: ArmOnBus, drive: Drive) -> None:
    try:
        owned = OwnedBus(arm, f"/right/can_bridge (PID {os.getpid()})", log)
    except BusError as error:
        log(str(error))
        raise SystemExit(1) from None
    notes = owned.notes
    ports = arm.ports(notes.clock)
    bus = MotorBus(ports, arm.motors, note=notes.note)  # the rig has switched the motors on
    is_announced = False
    while True:
        end = time.monotonic() + arm.period
        bus.exchange(drive, end)
        if not is_announced and notes.heartbeat and all(joint.time > 0.0 for joint in bus.samples):
            print(owned.watchdog.process.pid, flush=True)
            is_announced = True
        time.sleep(max(0.0, end - time.monotonic()))


if __name__ == "__main__":
    arm, effort = pickle.loads(Path(sys.argv[1]).read_bytes())
    main(arm, drive_of(effort))
