# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Measures the operator's panel on the simulated device: delay from press to torque, processor load, late cycles.

    python -m test.panel.measure press [N]   N presses of the space bar in a real browser, 50 by default, 5 s each
    python -m test.panel.measure load        both arms at 250 Hz, 40 s without the panel and 40 s with an open page
    python -m test.panel.measure memory [N]  both arms at 50 Hz and an open page for N minutes, 60 by default

`press` takes the time from the call that sends the key to the browser until the first CAN frame that fades: it has
damping, which an active arm never has. Needs chromium, and the extras panel, sim, imu and test.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from pathlib import Path

from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import is_special, unpack_command

from ..faults.live_arm import resident
from ..support.bus_listener import CAN_IDS, BusListener, Frame
from ..support.launched_nodes import LaunchedNodes
from ..support.panel_browser import chromium, enable, open_page, wait_for_state
from ..support.ros_probe import RosProbe

SPECS = [MOTORS[name] for name in ("AK60-6", "AK80-9", "AK60-6", "AK60-6")]
COMMANDS = (0x7F, 0x80, 0xFF)  # first byte: commands hold the position 0; see hardware/can/motor_bus.py
# The real device's rate, with time-outs that leave room for simulators and browser on the same computer.
TIMING = {
    "can_bridge": {"rate": 250.0, "command_timeout": 0.1},
    "compensator": {"tilt_timeout": 0.5},
}
SLOW = {**TIMING, "can_bridge": {**TIMING["can_bridge"], "rate": 50.0}}
PHASE = 40.0  # s
LONGEST = 0.15  # s, p99 from press to fading torque
LARGEST_SHARE = 0.15  # of a core
WARM_UP = 5  # min until memory counts: caches and plots fill
MAX_GROWTH = 5.0  # MB, of the node and of the tab, from then until the end


def first_fading(frames: list[Frame], since: float) -> float:
    """Return the time of the first frame with damping. Raises ValueError unless it comes after `since`."""
    for frame in frames:
        is_ours = frame.can_id in CAN_IDS and frame.data[0] in COMMANDS  # a reply carries the motor's ID as well
        if not is_ours or is_special(frame.data):
            continue
        if unpack_command(SPECS[frame.can_id - 1], frame.data).kd > 0.0:
            if frame.time < since:
                raise ValueError(f"a frame with damping {1000 * (since - frame.time):.1f} ms before the press")
            return frame.time
    raise ValueError("no frame with damping")


def press(count: int) -> int:
    """Measure from press to fading torque."""
    delays: list[float] = []
    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        nodes = LaunchedNodes(Path(folder))
        url = nodes.add_panel()
        nodes.start()
        listener, probe = BusListener(nodes.bus), RosProbe()
        try:
            probe.wait_until_carried()
            page = open_page(browser, url)
            for n in range(count):
                wait_for_state(page, "active")
                listener.frames.clear()
                pressed = time.time()
                page.keyboard.press("Space")
                wait_for_state(page, "letting down")
                delays.append(first_fading(list(listener.frames), pressed) - pressed)
                print(f"{n + 1}: {1000 * delays[-1]:.1f} ms", flush=True)
                if n + 1 < count:
                    enable(page)
        finally:
            probe.close()
            nodes.stop()
            listener.close()
    delays.sort()
    p99 = delays[min(len(delays) - 1, int(0.99 * len(delays)))]
    shown = f"median {1000 * statistics.median(delays):.1f} ms, p99 {1000 * p99:.1f} ms, max {1000 * delays[-1]:.1f} ms"
    print(f"{count} presses, from the key to the first fading torque on the bus: {shown}")
    return int(p99 > LONGEST)


def processor_time(pid: int) -> float:
    """Return the processor time of a process in s, all threads."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100.0


def load() -> int:
    """Measure the panel's share of a core with one page open, and late cycles without and with the panel."""
    with tempfile.TemporaryDirectory() as folder:
        counts = [_phase(Path(folder, name), name == "with") for name in ("without", "with")]
    for name, (late, incomplete, share) in zip(("without panel", "with panel and page"), counts, strict=True):
        shown = f", panel {100 * share:.1f} % of a core" if share else ""
        print(f"{name}: {late} late and {incomplete} incomplete cycles of both arms in {PHASE:g} s{shown}")
    return int(counts[1][2] > LARGEST_SHARE)


def _phase(folder: Path, panel: bool) -> tuple[int, int, float]:
    folder.mkdir()
    nodes = LaunchedNodes(folder, base="sim_both.yaml", timing=TIMING)
    url = nodes.add_panel() if panel else ""
    nodes.start()
    probe = RosProbe()
    try:
        probe.wait_until(lambda: {"/right/can_bridge", "/left/can_bridge"} <= set(probe.statuses))
        if not panel:
            return (*_cycles(probe), 0.0)
        with chromium() as browser:
            page = open_page(browser, url)
            page.locator("#plots").scroll_into_view_if_needed()
            pid = nodes.pid("/panel")
            before = processor_time(pid)
            late, incomplete = _cycles(probe)
            return late, incomplete, (processor_time(pid) - before) / PHASE
    finally:
        probe.close()
        nodes.stop()


def _cycles(probe: RosProbe) -> tuple[int, int]:
    def counts() -> tuple[int, ...]:
        bridges = [probe.statuses[f"/{side}/can_bridge"] for side in ("right", "left")]
        values = [{pair.key: pair.value for pair in bridge.values} for bridge in bridges]
        return tuple(sum(int(value[key]) for value in values) for key in ("late cycles", "incomplete cycles"))

    probe.wait_for_report()
    before = counts()
    time.sleep(PHASE)
    probe.wait_for_report()
    return counts()[0] - before[0], counts()[1] - before[1]


def memory(minutes: int) -> int:
    """Measure the memory of the node and of an open page, once a minute."""
    seen: list[tuple[float, float]] = []  # MB
    with tempfile.TemporaryDirectory() as folder, chromium(gives_way=True) as browser:
        nodes = LaunchedNodes(Path(folder), base="sim_both.yaml", timing=SLOW)
        url = nodes.add_panel()
        nodes.start()
        probe = RosProbe()
        try:
            probe.wait_until(lambda: any("the panel is at" in line for line in nodes.log))
            page = open_page(browser, url)
            page.locator("#plots").scroll_into_view_if_needed()
            tab = page.context.new_cdp_session(page)
            for minute in range(minutes + 1):
                page.wait_for_timeout(60_000.0 if minute else 0.0)
                tab.send("HeapProfiler.collectGarbage")
                heap = tab.send("Runtime.getHeapUsage")["usedSize"] / 1e6
                seen.append((resident(nodes.pid("/panel")), heap))
                print(f"{minute} min: node {seen[-1][0]:.1f} MB, tab {heap:.1f} MB", flush=True)
        finally:
            probe.close()
            nodes.stop()
    late = seen[WARM_UP:] or seen
    growth = [last - first for first, last in zip(late[0], late[-1], strict=True)]
    print(f"growth after the first {WARM_UP} min: node {growth[0]:.1f} MB, tab {growth[1]:.1f} MB")
    return int(max(growth) > MAX_GROWTH)


if __name__ == "__main__":
    what = sys.argv[1] if len(sys.argv) > 1 else ""
    if what == "press":
        raise SystemExit(press(int(sys.argv[2]) if len(sys.argv) > 2 else 50))
    if what == "load":
        raise SystemExit(load())
    if what == "memory":
        raise SystemExit(memory(int(sys.argv[2]) if len(sys.argv) > 2 else 60))
    print(__doc__)
    raise SystemExit(2)
