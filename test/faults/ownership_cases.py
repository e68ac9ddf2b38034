"""Rows of the fault matrix about who owns the bus: other sessions, silent motors handed over, a closed terminal."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from pathlib import Path

from ..support.ros_probe import Timeout
from .actions import has_refused, run_bridge, second_bridge, send_signal
from .device_faults import END_SILENCE, SILENCE
from .fault_case import ALL_JOINTS, PROCESS_REACTION, FaultCase
from .rig import Rig
from .rigs import LauncherRig

GIVEN_UP = 8.0  # s after which a watchdog says that its motors do not reply
START_LIMIT = 20.0  # s for the next bridge to start and to take the bus over, or to be refused


def start_in_another_session(rig: Rig) -> None:
    """Start a bridge as another user of the bus: it shares no folder with the first one."""
    folder = rig.folder / "another_session"
    folder.mkdir(exist_ok=True)
    names = ("XDG_RUNTIME_DIR", "HOME", "TMPDIR", "XDG_CACHE_HOME")
    rig.second_bridge = run_bridge(rig, "/second", environment=dict.fromkeys(names, str(folder)))


class HandedOverRig(LauncherRig):
    """An arm whose watchdog is alone with silent motors, and the next bridge."""

    next_bridge: subprocess.Popen[str] | None = None

    @property
    def log_of_next(self) -> Path:
        return self.folder / "next_bridge.log"

    def close(self) -> None:
        if self.next_bridge is not None:
            self._bridges.add(self.next_bridge.pid)
            self.next_bridge.kill()
            self.next_bridge.wait()
        super().close()


def start_with_silent_motors(rig: HandedOverRig) -> None:
    """Leave the watchdog alone with motors that do not reply; they reply again once the next bridge has the bus."""
    SILENCE(rig)
    bridge = rig.pid("can_bridge")
    rig.launcher.kill()
    os.kill(bridge, signal.SIGKILL)
    time.sleep(GIVEN_UP)
    with rig.log_of_next.open("w") as log:
        rig.next_bridge = second_bridge(rig, "/right", stdout=log, stderr=subprocess.STDOUT)
    with contextlib.suppress(Timeout):  # then it was refused
        rig.probe.wait_until(lambda: "letting the arm down" in rig.log_of_next.read_text(), START_LIMIT)
    END_SILENCE(rig)


def next_bridge_let_it_down(rig: HandedOverRig) -> None:
    log = rig.log_of_next.read_text()
    assert "the arm is down, its motors are off" in log, f"the next bridge did not let the arm down: {log[-300:]}"


# fmt: off
OWNERSHIP = (
    FaultCase("can_bridge of another session on the bus", start_in_another_session, limit=None, outcomes=("active",),
        afterwards=has_refused),
    FaultCase("motors silent for long, then the next can_bridge", start_with_silent_motors, HandedOverRig, limit=None,
        unreached=ALL_JOINTS, afterwards=next_bridge_let_it_down, ends_rig=True),
    FaultCase("can_bridge: SIGHUP", send_signal("can_bridge", signal.SIGHUP), limit=PROCESS_REACTION),
    FaultCase("launcher's terminal closed", lambda rig: rig.launcher.send_signal(signal.SIGHUP), LauncherRig,
        PROCESS_REACTION),
)
# fmt: on
