"""What a listener on the bus saw of a fault: how soon the arm was let down, and how gently."""

from dataclasses import dataclass

from exo_gravity.core.motors import ENTER, EXIT, MOTORS, unpack_command, unpack_reply

RATE = 50.0  # Nm/s
SPEED = 1.0  # rad/s
SPECS = {1: MOTORS["AK60-6"], 2: MOTORS["AK80-9"], 3: MOTORS["AK60-6"], 4: MOTORS["AK60-6"]}


@dataclass
class Seen:
    """Of the frames since a fault: s until damping or EXIT came (None: never), rad/s, and Nm at most.

    excess: Nm by which the worst step of a torque exceeded what the rate allows in one period, the wire's own
    resolution apart. armed: whether a motor was switched on again.
    """

    reaction: float | None
    speed: float
    step: float
    excess: float
    armed: bool


def seen(frames, since, period, until=None):
    """Return what `frames` show from `since` to `until` (s, as the frames' own times)."""
    reaction, speed, step, excess, off, armed, before = None, 0.0, 0.0, 0.0, False, False, {}
    for when, to, data in frames:
        if to not in SPECS or (until and when > until):
            continue
        spec, now = SPECS[to], when >= since
        if data in (ENTER, EXIT):
            off = off or (now and data == EXIT)
            armed = armed or (off and data == ENTER)
            safe = data == EXIT
        elif data[:1] == bytes([to]):
            speed = max(speed, abs(unpack_reply(spec, data).velocity)) if now else speed
            safe = False
        else:
            command = unpack_command(spec, data)
            change = abs(command.torque - before.get(to, command.torque))
            before[to] = command.torque
            if now:
                step = max(step, change)
                excess = max(excess, change - RATE * period - 2 * spec.torque_range / 0xFFF)
            safe = command.kd > 0.0
        if now and safe and reaction is None:
            reaction = when - since
    return Seen(reaction, speed, step, excess, armed)
