"""How an arm responds to a fault, from the frames on its bus: how soon it is let down, and how gently."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from exo_gravity.core.motors import ENTER, EXIT, MOTORS, unpack_command, unpack_reply

from ..support.bus_listener import Frame

MAX_EFFORT_RATE = 50.0  # Nm/s
SPECS = {1: MOTORS["AK60-6"], 2: MOTORS["AK80-9"], 3: MOTORS["AK60-6"], 4: MOTORS["AK60-6"]}


@dataclass
class Response:
    """What the frames since a fault show.

    reaction: s until the first damping or EXIT frame, None without one. top_speed: rad/s. largest_step: Nm between two
    commands to a motor. excess: Nm by which the worst step exceeds what `MAX_EFFORT_RATE` allows in one period, plus
    two codes of the frame's resolution. re_enabled: whether a motor was switched on again after it was switched off.
    """

    reaction: float | None = None
    top_speed: float = 0.0
    largest_step: float = 0.0
    excess: float = 0.0
    re_enabled: bool = False


def measure_response(frames: Iterable[Frame], fault_time: float, period: float) -> Response:
    """Return the response to a fault at `fault_time` (s of the frames' clock) of a loop with `period` s."""
    response, switched_off = Response(), False
    last_torque: dict[int, float] = {}
    for time, can_id, data in frames:
        if can_id not in SPECS:
            continue
        spec, since_fault = SPECS[can_id], time >= fault_time
        if data in (ENTER, EXIT):
            switched_off |= since_fault and data == EXIT
            response.re_enabled |= switched_off and data == ENTER
            lets_down = data == EXIT
        elif data[:1] == bytes([can_id]):
            speed = abs(unpack_reply(spec, data).velocity) if since_fault else 0.0
            response.top_speed = max(response.top_speed, speed)
            lets_down = False
        else:
            command = unpack_command(spec, data)
            step = abs(command.torque - last_torque.get(can_id, command.torque))
            last_torque[can_id] = command.torque
            if since_fault:
                allowed = MAX_EFFORT_RATE * period + 2 * spec.torque_range / 0xFFF
                response.largest_step = max(response.largest_step, step)
                response.excess = max(response.excess, step - allowed)
            lets_down = command.kd > 0.0
        if since_fault and lets_down and response.reaction is None:
            response.reaction = time - fault_time
    return response
