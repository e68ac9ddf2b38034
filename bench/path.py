# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The path of a torque, counted: from the CAN frame that holds an encoder reading to the frame that holds the torque.

    python -m bench.path [--hops]

One cycle of a carried arm, whose controller is a compensator without messages, from the arrival of the last motor's
reply until that motor's next command is sent. Counted are the functions that run and their calls, their files, and the
records (named tuples and frozen dataclasses) that are made; what belongs to the simulation is not. --hops: print each.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import can

import exo_gravity
from exo_gravity.core.compensation.compensator import JOINTS, Compensator
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.inputs.arms import read_arm
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.sim import SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.controllers import DirectController
from exo_gravity.sim.virtual_arm import VirtualArm, resting
from exo_gravity.sim.virtual_time import VirtualBus, Wire

RATE = 250.0  # Hz
PACKAGE = Path(exo_gravity.__file__).parent
PATH = (str(PACKAGE / "core"), str(PACKAGE / "hardware"))
SIMULATION = str(PACKAGE / "sim")
INLINE = ("<genexpr>", "<lambda>", "<listcomp>")  # count as part of the function that they stand in


class Trace:
    """What ran: `calls` of each function by (file, line, name), and the names of the `records` that were made."""

    def __init__(self) -> None:
        self.calls: Counter[tuple[str, int, str]] = Counter()
        self.records: Counter[str] = Counter()

    def start(self) -> None:
        """Count from now on."""
        sys.setprofile(self._note)

    def stop(self) -> None:
        """Stop counting."""
        sys.setprofile(None)

    def _note(self, frame: FrameType, event: str, _argument: Any) -> None:
        if event != "call":
            return
        code = frame.f_code
        if _is_simulation(frame):
            return
        if code.co_filename.startswith(PATH):
            if code.co_name not in INLINE:
                self.calls[code.co_filename, code.co_firstlineno, code.co_name] += 1
        elif code.co_filename == "<string>":  # made by namedtuple or dataclass
            kind = frame.f_locals.get("_cls") or type(frame.f_locals.get("self"))
            if kind.__module__.startswith("exo_gravity."):
                self.records[kind.__name__] += 1


def _is_simulation(frame: FrameType | None) -> bool:
    """Return whether a frame was called by the simulation: by its bus, which lets the simulated time pass."""
    while frame is not None:
        if frame.f_code.co_filename.startswith(SIMULATION):
            return True
        frame = frame.f_back
    return False


class TracedBus(VirtualBus):
    """The loop's end of a wire: calls `on_reply` when the last motor's reply arrives, `on_command` at its command."""

    def __init__(self, wire: Wire, last: int, on_reply: Callable[[], None], on_command: Callable[[], None]) -> None:
        super().__init__(wire)
        self._seen: set[int] = set()
        self._last, self._on_reply, self._on_command = last, on_reply, on_command

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame."""
        message = super().recv(timeout)
        if message:
            self._seen.add(message.data[0])
            if len(self._seen) == self._last:
                self._seen.clear()
                self._on_reply()
        return message

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame."""
        if msg.arbitration_id == self._last:
            self._on_command()
        super().send(msg, timeout)


class TracedWire(Wire):
    """A wire whose one bus is traced."""

    on_reply: Callable[[], None] = staticmethod(lambda: None)
    on_command: Callable[[], None] = staticmethod(lambda: None)

    def open(self, *_: object) -> VirtualBus:
        """Open the bus."""
        bus = TracedBus(self, len(JOINTS), lambda: self.on_reply(), lambda: self.on_command())
        self.ends.append(bus)
        return bus


def traced_cycle() -> Trace:
    """Return what runs in one cycle of a carried arm that hangs."""
    arm = read_arm(load(packaged_config("sim.yaml")), "/right")
    device = SimulatedDevice(SimulatedArm(), [SimulatedMotor(motor) for motor in arm.motors])
    limits = Limits(arm.joint_names, sign_check_torque=0.0)
    controller, wire, trace = DirectController(Compensator(arm.settings), limits), TracedWire(), Trace()
    virtual = VirtualArm(device, controller, arm.motors, limits, RATE, wire)
    virtual.add_imu(resting(0.0, 0.0), controller.compensator, 1.0 / RATE)
    virtual.enable()
    assert virtual.run_until(lambda: virtual.safety.state is State.ACTIVE), virtual.safety.waiting_for
    virtual.run(0.5)
    wire.on_reply, wire.on_command = trace.start, trace.stop
    virtual.loop.cycle()
    wire.on_reply = lambda: None
    virtual.loop.cycle()
    virtual.loop.stop()
    return trace


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(prog="bench.path", description="Count the path of a torque.")
    parser.add_argument("--hops", action="store_true", help="print each function and record")
    options = parser.parse_args()
    trace = traced_cycle()
    files = {file for file, _, _ in trace.calls}
    if options.hops:
        for (file, _, name), count in trace.calls.items():
            print(f"{count:4}  {Path(file).relative_to(PACKAGE)}  {name}")
        for kind, count in trace.records.items():
            print(f"{count:4}  {kind}")
    calls, records = sum(trace.calls.values()), sum(trace.records.values())
    print(f"{len(trace.calls)} functions, called {calls} times, in {len(files)} files; {records} records", end=" ")
    print(f"of {len(trace.records)} kinds")


if __name__ == "__main__":
    main()
