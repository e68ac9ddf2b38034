# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A process that carries an arm as a bridge does; `python -m test.hardware.carrier FILE`, FILE a pickled arm.

It prints the PID of its watchdog once the motors are on and the watchdog runs.
"""

import os
import pickle
import sys
import time
from functools import partial
from pathlib import Path

from exo_gravity.hardware.motor_bus import MotorBus
from exo_gravity.hardware.owned_bus import OwnedBus

from ..support.simulated_device import command_of

arm, effort = pickle.loads(Path(sys.argv[1]).read_bytes())
log = partial(print, file=sys.stderr, flush=True)
owned = OwnedBus(arm, f"/right/can_bridge (PID {os.getpid()})", log)
bus = MotorBus(arm.ports(owned.notes.clock), arm.motors, note=owned.notes.note)  # the motors are on
is_announced = False
while True:
    end = time.monotonic() + arm.period
    bus.exchange(command_of(effort), end)
    if not is_announced and owned.notes.heartbeat and all(joint.time > 0.0 for joint in bus.samples):
        print(owned.watchdog.process.pid, flush=True)
        is_announced = True
    time.sleep(max(0.0, end - time.monotonic()))
