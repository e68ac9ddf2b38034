# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The path of a torque, counted: from the CAN frame that holds an encoder reading to the frame that holds the torque.

    python -m bench.path [--hops]

One cycle of a carried arm, whose controller is a compensator without messages, from the arrival of the last motor's
reply until that motor's next command is sent. Counted are the functions that run and their calls, their files, and the
records (named tuples and frozen dataclasses) that are made; what belongs to the simulation is not. --hops: print each.
"""

import argparse
import sys
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import can

import exo_gravity
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.safety.command import State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.inputs.arms import read_arm
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.sim import SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.controllers import DirectController
from exo_gravity.sim.virtual_arm import VirtualArm, resting
from exo_gravity.sim.virtual_time import VirtualBus

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

    def note(self, frame: FrameType, event: str, _argument: Any) -> None:
        """Count a call, unless the simulation makes it."""
        if event != "call" or _is_simulation(frame):
            return
        code = frame.f_code
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


def traced_cycle() -> Trace:
    """Return what runs in one cycle of a carried arm that hangs."""
    arm, trace = read_arm(load(packaged_config("sim.yaml")), "/right"), Trace()
    device = SimulatedDevice(SimulatedArm(), [SimulatedMotor(motor) for motor in arm.motors])
    limits = Limits(arm.joint_names, sign_check_torque=0.0)
    controller = DirectController(Compensator(arm.settings), limits)
    virtual = VirtualArm(device, controller, arm.motors, limits, RATE)
    virtual.add_imu(resting(0.0, 0.0), controller.compensator, 1.0 / RATE)
    virtual.enable()
    assert virtual.run_until(lambda: virtual.safety.state is State.ACTIVE), virtual.safety.waiting_for
    virtual.run(0.5)
    (bus,) = (end for end in virtual.wire.ends if isinstance(end, VirtualBus))
    receive, send, last, seen = bus._recv_internal, bus.send, arm.motors[-1].can_id, set[int]()

    def traced_receive(timeout: float | None = None) -> tuple[can.Message | None, bool]:
        if (received := receive(timeout))[0]:
            seen.add(received[0].data[0])
            if len(seen) == len(arm.motors) and not trace.calls:
                sys.setprofile(trace.note)
        return received

    def traced_send(message: can.Message, timeout: float | None = None) -> None:
        if message.arbitration_id == last:
            sys.setprofile(None)
        send(message, timeout)

    vars(bus).update(_recv_internal=traced_receive, send=traced_send)
    virtual.loop.cycle()
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
