# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A motor on a joint, the parameters of an arm's motors, and the load of their frames on the CAN bus.

A `JointMotor` translates a joint's effort and damping to the frames of its wire format, and frames to `JointSample`s.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import MIT, USUAL_MOTORS
from exo_gravity.core.motors.families import FORMATS, MOTORS, format_of
from exo_gravity.core.motors.frames import EXTENDED, Frame, MotorSpec, Setting, WireFormat
from exo_gravity.core.numbers import one_float
from exo_gravity.core.params import Param
from exo_gravity.core.vocabulary import Source

# In the format `mit` the first byte of an AK motor's reply is its ID. The position of our commands is 0, unless they
# hold a joint (`MotorBus`), so their first byte is 0x7f or 0x80: with IDs below 0x7f their echoes cannot look like
# replies.
MAX_CAN_ID = 126
MAX_MASTER_ID = 0x7FE
TORQUE_SCALE_BOUNDS = (0.2, 2.0)
# 1/K: the remanence of a neodymium magnet falls by about 0.0012 of itself per kelvin, of a ferrite by 0.002, and with
# it the torque per ampere.
SCALE_SLOPE_BOUNDS = (-0.003, 0.003)
SCALE_TEMPERATURE = 25.0  # degC at which torque_scale is true, unless it was measured warm or cold
SCALE_TEMPERATURE_BOUNDS = (-40.0, 150.0)  # degC
LARGEST_WARMING = 60.0  # K from there that torque follows: a sensor without connection reads far beyond
# rad: 12.5 in the manual, 12.56 or 12.566 in firmware. Another one is a mistake that would scale every angle.
POSITION_RANGE_BOUNDS = (12.4, 12.6)
# By which factor a wire range of speed or torque may differ from the motor's usual one: firmware was met with 0.45 of
# it and with 1.4; a slip of the decimal point is refused.
WIRE_RANGE_FACTOR = 3.0
TORQUE_PER_AMPERE_BOUNDS = (0.02, 5.0)  # Nm/A at the output
# s without a command after which a motor lets go. A shorter one fires in an ordinary stall of the computer, and drops
# the arm without damping; a longer one leaves a motor pushing after its host has died.
TIMEOUT_BOUNDS = (0.15, 0.5)
OPTIONS = "can.options"  # parameters below this prefix go to python-can unchanged
BITRATE = 1_000_000  # bit/s, of AK and Damiao motors as delivered
DATA_BITRATE = 5_000_000  # bit/s, of the data of CAN FD frames, as Damiao motors and OpenArm's documents have it
MAX_DATA_BITRATE = 8_000_000  # bit/s, of CAN FD
# Status frames a second that are to be set on V3 boards: the most they can send, because each cycle waits for one; on a
# slow bus fewer, or the paper's four boards would fill it.
MAX_STATUS_RATE, SLOW_STATUS_RATE = 500.0, 200.0
SLOW_BITRATE = 500_000  # bit/s, below which a bus is slow
REPLY_SHARE = 0.8  # of a cycle in which replies are awaited
# python-can's interfaces that open a bus at another bit rate than the motors' unless they are given one, or at the one
# that their adapter had last. test/hardware/test_adapters.py compares them with python-can's sources.
NEED_BITRATE = (
    "canalystii", "cantact", "gs_usb", "iscan", "ixxat", "kvaser", "neousys", "neovi", "nican", "nixnet", "pcan",
    "robotell", "seeedstudio", "slcan", "systec", "usb2can", "vector",
)  # fmt: skip
Address = tuple[str, str, Mapping[str, Any]]  # interface, channel and options of a python-can bus


class JointSample(NamedTuple):
    """What a motor's frame says of its joint."""

    position: float  #: rad
    velocity: float  #: rad/s
    effort: float  #: Nm
    temperature: int | None  #: degC, None if the firmware reports none
    error: int | None  #: the board's code of an error, 0 for none; None if the firmware reports none
    time: float  #: s on the clock of the bus, when the frame arrived
    on: bool | None = None  #: whether the motor is on; None from boards that do not say
    trouble: str = ""  #: what an error means, or why the motor has switched itself off


UNKNOWN = JointSample(math.nan, math.nan, math.nan, None, None, -math.inf)  # before the first frame


@dataclass(frozen=True)
class JointMotor:
    """One motor on one joint. Raises ParameterError."""

    spec: MotorSpec
    can_id: int  #: 1 to MAX_CAN_ID
    direction: int = 1  #: 1 or -1: joint angle = direction * (motor angle - zero)
    zero: float = 0.0  #: motor angle in rad at which the joint angle is 0
    torque_scale: float = 1.0  #: real output torque per commanded Nm (users report 0.75 for one AK80-9)
    wire_format: WireFormat = MIT  #: of the motor's board
    timeout: float = 0.0  #: s without a command after which the firmware lets go; 0: never
    master_id: int = 0  #: arbitration ID of replies, where it can be chosen; 0: the usual one
    scale_slope: float = 0.0  #: 1/K, share by which `torque_scale` changes with the motor's temperature
    scale_temperature: float = SCALE_TEMPERATURE  #: degC at which `torque_scale` is true
    command_id: int = field(init=False)  #: the arbitration ID of commands
    reply_id: int = field(init=False)  #: the arbitration ID of replies or status frames
    settings: Sequence[Setting] = field(init=False)  #: that the board must have
    #: the frames that switch the motor on, before its next command; that switch it off; that make its present angle
    #: zero, and that clear its error, none if its board has no such frame
    enter: tuple[Frame, ...] = field(init=False)
    exit: tuple[Frame, ...] = field(init=False)
    set_zero: tuple[Frame, ...] = field(init=False)
    clear_error: tuple[Frame, ...] = field(init=False)
    #: Nm at the joint, for any time: a motor that gives less than commanded already has its rated current when its
    #: rated torque is commanded; and for seconds
    rated_effort: float = field(init=False)
    peak_effort: float = field(init=False)
    idle: Frame = field(init=False)  #: a command without torque and gains
    peak_damping: float = field(init=False)  #: Nm s/rad at the joint, the most that a command can ask for

    def __post_init__(self) -> None:
        if (family := self.wire_format.family) != self.spec.family:
            raise ParameterError("wire_format", self.wire_format.name, f"that of a {self.spec.name}, not of {family}")
        last = self.wire_format.last_id
        if not isinstance(self.can_id, int) or not 1 <= self.can_id <= last:
            raise ParameterError("can_id", self.can_id, f"a whole number from 1 to {last} for a {self.spec.name}")
        if self.direction not in (1, -1):
            raise ParameterError("direction", self.direction, "1 or -1")
        limit = self.spec.position_range - math.pi
        if not abs(self.zero) <= limit:
            raise ParameterError("zero", self.zero, f"from {-limit:.2f} to {limit:.2f} rad, or the angle would wrap")
        one_float("torque_scale", self.torque_scale, *TORQUE_SCALE_BOUNDS)
        one_float("torque_scale_slope", self.scale_slope, *SCALE_SLOPE_BOUNDS, "1/K")
        one_float("torque_scale_temperature", self.scale_temperature, *SCALE_TEMPERATURE_BOUNDS, "degC")
        shortest, longest = TIMEOUT_BOUNDS
        spec, board = self.spec, self.wire_format
        if (self.timeout or board.needs_timeout) and not shortest <= self.timeout <= longest:
            never = "" if board.needs_timeout else "0 (never) or "
            expected = f"{never}from {shortest:g} to {longest:g} s: set it in the motor's firmware (docs/wiring.md)"
            raise ParameterError("motor_timeout", self.timeout, expected)
        reply_id = board.reply_id(self.can_id, self.master_id)
        frames = {"enter": board.on, "exit": board.off, "set_zero": board.zero, "clear_error": board.clear_error}
        derived: dict[str, object] = {
            "command_id": board.first_id + self.can_id,
            "reply_id": reply_id,
            "settings": tuple(board.settings(spec, self.can_id, reply_id, self.timeout)),
            **{name: tuple((first + self.can_id, data) for first, data in own) for name, own in frames.items()},
            "rated_effort": spec.rated_torque * min(1.0, self.torque_scale),
            "peak_effort": min(spec.peak_torque, spec.torque_range) * self.torque_scale,
            "peak_damping": spec.kd_max * self.torque_scale,
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "idle", (self.command_id, self.command(0.0, 0.0)))

    def scale_at(self, temperature: float | None) -> float:
        """Return the real torque per commanded torque of a motor at `temperature` degC, None if that is not known."""
        if not self.scale_slope or temperature is None:
            return self.torque_scale
        return scale_at(self.torque_scale, self.scale_slope, self.scale_temperature, temperature)

    def warmed(self, temperature: float | None) -> float:
        """Return by which share the torque per command differs at `temperature` degC from `torque_scale`."""
        return self.scale_at(temperature) / self.torque_scale - 1.0

    def command(
        self,
        effort: float,
        damping: float,
        stiffness: float = 0.0,
        position: float = 0.0,
        temperature: float | None = None,
    ) -> bytes:
        """Return the data of a command: a joint `effort` in Nm and `damping` in Nm s/rad, clamped to the wire format.

        With a `stiffness` in Nm/rad, the motor also pulls the joint to `position` in rad.
        temperature: of the motor in degC, None if it is not known.

        Raises ParameterError on NaN or infinity.
        """
        spec, scale = self.spec, self.scale_at(temperature)
        torque = self.direction * effort / scale
        kd = min(damping / scale, spec.kd_max)
        if kd:  # no code is exactly 0 rad/s: the nearest one would push with kd times its velocity
            torque -= kd * spec.standstill
        most = spec.torque_range
        if not -most <= torque <= most and math.isfinite(torque):
            torque = math.copysign(most, torque)
        # A reading at the end of the range exceeds it by a rounding. NaN stays NaN.
        angle = min(max(self.motor_position(position), -spec.position_range), spec.position_range) if stiffness else 0.0
        return self.wire_format.pack_command(spec, angle, 0.0, stiffness / scale, kd, torque)

    def sample(self, data: bytes | bytearray, time: float) -> JointSample:
        """Return what a reply or status frame that arrived at `time` s says of the joint. Raises FrameError."""
        board = self.wire_format
        _, position, velocity, torque, temperature, error = board.unpack_reply(self.spec, self.can_id, data)
        sign = self.direction
        effort = sign * torque * self.scale_at(temperature)
        trouble = board.error_text(error) if error else ""
        if error in board.let_go:
            error = 0
        angle, speed = sign * (position - self.zero), sign * velocity
        return JointSample(angle, speed, effort, temperature, error, time, board.says_on(data), trouble)

    def motor_position(self, joint_position: float) -> float:
        """Return the motor angle in rad for a joint angle in rad."""
        return self.direction * joint_position + self.zero


def scale_at(scale: float, slope: float, reference: float, temperature: float) -> float:
    """Return the torque scale at `temperature` degC of a motor that has `scale` at `reference` degC; slope: 1/K."""
    warming = max(-LARGEST_WARMING, min(LARGEST_WARMING, temperature - reference))
    return scale * (1.0 + slope * warming)


LARGEST_ZERO = POSITION_RANGE_BOUNDS[1]  # rad; `JointMotor` has the limit of each motor
SIMULATED_BUSES = ("udp_multicast", "virtual")  # interfaces of python-can that lead to no motor
VIRTUAL_CAN = "vcan"  # begins Linux's names of CAN interfaces without an adapter: only programs are behind one

# fmt: off
# `can_bridge` assumes these properties of its motors; `simulator` builds motors that have them.
MOTOR_PARAMETERS = (
    Param("can.interface", "", "python-can interface, e.g. socketcan, udp_multicast", fixed=True, required=True),
    Param("can.channel", "", "python-can channel, e.g. can0; with two buses can0,can0,can1,can1",
          fixed=True, required=True),
    Param("motor", list(USUAL_MOTORS), "motor types", choices=MOTORS, fixed=True),
    Param("can_id", [1, 2, 3, 4], "CAN IDs", (1, MAX_CAN_ID), fixed=True),
    Param("direction", [1, 1, 1, 1], "1 or -1: joint angle = direction * (motor angle - zero)", (-1, 1), fixed=True),
    Param("zero", [0.0] * 4, "motor angle at which the joint angle is 0", (-LARGEST_ZERO, LARGEST_ZERO), "rad",
          fixed=True),
    Param("torque_scale", [1.0] * 4, "real output torque per commanded Nm", TORQUE_SCALE_BOUNDS, fixed=True),
    Param("torque_scale_slope", [0.0] * 4, "change of torque_scale per kelvin, about -0.001 of a neodymium magnet",
          SCALE_SLOPE_BOUNDS, "1/K", fixed=True),
    Param("torque_scale_temperature", [SCALE_TEMPERATURE] * 4, "motor temperature at which torque_scale is true",
          SCALE_TEMPERATURE_BOUNDS, "degC", fixed=True),
    Param("wire_format", ["mit"] * 4, "mit_v3 for V3 boards of AK motors, mit for others", choices=FORMATS, fixed=True),
    Param("master_id", [0] * 4, "CAN ID of a Damiao motor's replies; 0: can_id + 16", (0, MAX_MASTER_ID),
          fixed=True),
    Param("position_range", [0.0] * 4, "range of the firmware's wire format; 0: the motor's usual one",
          (0.0, POSITION_RANGE_BOUNDS[1]), "rad", fixed=True),
    Param("velocity_range", [0.0] * 4, "range of the firmware's wire format; 0: the motor's usual one",
          unit="rad/s", fixed=True),
    Param("torque_range", [0.0] * 4, "range of the firmware's wire format; 0: the motor's usual one",
          unit="Nm", fixed=True),
    Param("torque_per_ampere", [0.0] * 4, "by which a V3 board divides torque for its current; 0: the usual one",
          (0.0, TORQUE_PER_AMPERE_BOUNDS[1]), "Nm/A", fixed=True),
    Param("motor_timeout", [0.0] * 4, "after which the firmware lets go without a command, 0.15 to 0.5; 0: never (not "
          "Damiao)", unit="s", fixed=True),
)
# fmt: on
# The bounds of any value but 0, of the parameters for which 0 stands for the usual one.
_BOUNDS_BEYOND_0 = {"position_range": POSITION_RANGE_BOUNDS, "torque_per_ampere": TORQUE_PER_AMPERE_BOUNDS}
_OF_A_MOTOR = tuple(param.name for param in MOTOR_PARAMETERS if isinstance(param.default, list))


def motors_of(values: Mapping[str, Any]) -> tuple[JointMotor, ...]:
    """Return the motors that parameter values describe, one per joint, or raise ParameterError."""
    ids = values["can_id"]
    if len(set(ids)) != len(ids):
        raise ParameterError("can_id", ids, f"{len(ids)} different IDs")
    motors = tuple(_motor_of({name: values[name][joint] for name in _OF_A_MOTOR}) for joint in range(len(ids)))
    replying = [motor for motor in motors if motor.command_id != motor.reply_id < EXTENDED]
    for motor, other in itertools.product(replying, motors):
        bits = other.wire_format.id_bits
        if motor.reply_id & (1 << bits) - 1 == other.can_id:
            expected = f"without the lowest {bits} bits of motor {other.can_id}, which would obey the replies"
            raise ParameterError("master_id", motor.reply_id, expected)
    return motors


def channels_of(channel: str, count: int) -> list[str]:
    """Return the channel of each of `count` motors that the value of `can.channel` names. Raises ParameterError."""
    names = [name.strip() for name in channel.split(",")]
    if len(names) not in (1, count) or not all(names):
        expected = f"one channel for all motors, or {count} with commas between them, one for each motor"
        raise ParameterError("can.channel", channel, expected)
    return names * (count // len(names))


def source_of_bus(interface: str, channel: str) -> Source:
    """Return whether the motors on a bus are real: the values of `can.interface` and `can.channel`."""
    if interface in SIMULATED_BUSES:
        return Source.SIMULATED
    names = [name.strip() for name in channel.split(",")]
    is_unknown = any(not name or name.startswith(VIRTUAL_CAN) for name in names)
    return Source.UNKNOWN if is_unknown else Source.REAL


def buses_of(channel: str, options: Mapping[str, Any], count: int) -> dict[str, tuple[list[int], dict[str, Any]]]:
    """Return which of `count` motors, from 0 on, are on each bus, by its channel, and its options for python-can.

    An option that is a list has an entry for each motor. Raises ParameterError.
    """
    buses: dict[str, tuple[list[int], dict[str, Any]]] = {}
    for joint, name in enumerate(channels_of(channel, count)):
        own = {}
        for key, value in options.items():
            if isinstance(value, list) and len(value) != count:
                raise ParameterError(f"{OPTIONS}.{key}", value, f"one value, or {count}, one for each motor")
            own[key] = value[joint] if isinstance(value, list) else value
        motors, first = buses.setdefault(name, ([], own))
        if own != first:
            raise ParameterError(OPTIONS, dict(options), f"the same for all motors on {name}")
        motors.append(joint)
    return buses


def _motor_of(given: Mapping[str, Any]) -> JointMotor:
    """Return one motor with the ranges of its firmware, 0 for the usual ones; raises ParameterError.

    A range that is usual on V1 and V2 boards is refused for another: it would scale every torque without an error.
    """
    plain, board = MOTORS[given["motor"]], format_of(given["motor"], given["wire_format"])
    usual = board.ranged(plain)
    for name in ("velocity_range", "torque_range"):
        own = getattr(usual, name)
        if given[name] == getattr(plain, name) != own:
            raise ParameterError(name, given[name], f"{own:g} or 0 for an {plain.name} with wire_format = {board.name}")
        low, high = own / WIRE_RANGE_FACTOR, own * WIRE_RANGE_FACTOR
        if given[name] and not low <= given[name] <= high:
            expected = f"0, the usual one, or from {low:g} to {high:g} for motor = {plain.name}"
            raise ParameterError(name, given[name], expected)
    if given["torque_per_ampere"] and board.replies:
        expected = f"0 with wire_format = {board.name}, whose replies carry the torque itself"
        raise ParameterError("torque_per_ampere", given["torque_per_ampere"], expected)
    for name, (low, high) in _BOUNDS_BEYOND_0.items():
        if given[name] and not low <= given[name] <= high:
            raise ParameterError(name, given[name], f"0, the usual one of the motor, or from {low:g} to {high:g}")
    names = "position_range", "velocity_range", "torque_range", "torque_per_ampere"
    spec = replace(usual, **{name: given[name] for name in names if given[name]})
    mounting = given["can_id"], given["direction"], given["zero"], given["torque_scale"]
    warmth = given["torque_scale_slope"], given["torque_scale_temperature"]
    return JointMotor(spec, *mounting, board, given["motor_timeout"], given["master_id"], *warmth)


class FrameBits(NamedTuple):
    """The bits of a kind of frame with 8 bytes of data."""

    typical: int  #: the mean over the poses, speeds and torques of an arm that is being carried
    most: int


COMMAND_BITS, REPLY_BITS = FrameBits(124, 135), FrameBits(118, 135)  # of V1 and V2 boards
V3_COMMAND_BITS, STATUS_BITS = FrameBits(146, 160), FrameBits(141, 160)
# Of CAN FD frames with 11-bit IDs and 8 bytes: at the bit rate of arbitration, and at that of data.
FD_BITS = FrameBits(32, 34)
FD_COMMAND_BITS, FD_REPLY_BITS = FrameBits(106, 113), FrameBits(99, 113)


@dataclass(frozen=True)
class Traffic:
    """The motors on one bus, its bit rate, and the highest control rate that fits. Raises ParameterError.

    In each cycle every motor gets a command of 8 bytes. V1 and V2 boards reply with 8 bytes, or 6 on older firmware; V3
    boards send status frames of 8 bytes on their own timer, and have 29-bit IDs. Of a classic CAN frame with n bytes of
    data (ISO 11898-1), 34 + 8 n bits are subject to stuffing, with a 29-bit ID 20 more, and 13 are not. It has at most
    (34 + 8 n - 1) // 4 stuff bits (Davis et al. 2007, "Controller Area Network schedulability analysis", eq. 1). The
    actual number depends on the bytes (test/core/test_bus_load.py).

    Of a CAN FD frame with 8 bytes, 17 bits before the data and 13 after them have the bit rate of arbitration, and 96
    that of data, of which 69 are subject to stuffing (ISO 11898-1:2015: a stuff count, 17 bits of CRC, 6 fixed stuff
    bits).
    """

    replying: int  #: motors of V1 and V2 boards
    reporting: int = 0  #: motors of V3 boards
    bitrate: int = BITRATE  #: bit/s
    data_bitrate: int = 0  #: bit/s, of the data of CAN FD frames; 0: frames of classic CAN

    def __post_init__(self) -> None:
        if not isinstance(self.bitrate, int) or not 10_000 <= self.bitrate <= 1_000_000:
            raise ParameterError("can.options.bitrate", self.bitrate, "a whole number from 10000 to 1000000 bit/s")
        if self.data_bitrate and self.data_bitrate not in range(self.bitrate, MAX_DATA_BITRATE + 1):
            expected = f"a whole number from {self.bitrate}, the bit rate, to {MAX_DATA_BITRATE} bit/s"
            raise ParameterError("can.options.data_bitrate", self.data_bitrate, expected)

    @property
    def status_rate(self) -> float:
        """Status frames a second of each V3 board on this bus."""
        return MAX_STATUS_RATE if self.bitrate >= SLOW_BITRATE else SLOW_STATUS_RATE

    def load(self, rate: float, worst: bool = False) -> float:
        """Return the share of the bus that `rate` cycles a second take, for typical or for `worst` stuffing."""
        kinds = COMMAND_BITS, REPLY_BITS, V3_COMMAND_BITS, STATUS_BITS, FD_BITS, FD_COMMAND_BITS, FD_REPLY_BITS
        command, reply, v3_command, status, *fd = (bits.most if worst else bits.typical for bits in kinds)
        exchange = (command + reply) / self.bitrate  # s
        if self.data_bitrate:
            exchange = 2.0 * fd[0] / self.bitrate + (fd[1] + fd[2]) / self.data_bitrate
        reports = self.reporting * (rate * v3_command + self.status_rate * status) / self.bitrate
        return rate * self.replying * exchange + reports

    @property
    def largest_rate(self) -> float:
        """Cycles/s that fill the bus, for typical stuffing."""
        unasked = self.load(0.0)
        return max(0.0, 1.0 - unasked) / (self.load(1.0) - unasked)

    def is_crowded(self, rate: float) -> bool:
        """Return whether replies may be late at `rate` although they fit on the bus."""
        return self.load(rate) > REPLY_SHARE or self.load(rate, worst=True) > 1.0

    def check(self, rate: float) -> None:
        """Raise ParameterError if the typical load of `rate` exceeds the capacity of the bus."""
        if (share := self.load(rate)) > 1.0:
            motors, capacity = self.replying + self.reporting, self.bitrate / 1000.0
            fits = f"at most {int(self.largest_rate)} Hz, the capacity of the CAN bus"
            need = f"{share * capacity:.0f} kbit/s of its {capacity:g}"
            if self.data_bitrate:
                need = f"{share:.0%} of its time"
            raise ParameterError("rate", rate, f"{fits}: {motors} motors need {need}")


def traffic_of(values: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Traffic]:
    """Return the traffic on each bus of an arm's motors, by its channel; options: of python-can.

    Raises ParameterError.
    """
    traffic, interface = {}, values["can.interface"]
    for name, (motors, own) in buses_of(values["can.channel"], options, len(values["wire_format"])).items():
        bitrate = own.get("bitrate")
        if bitrate is None and interface in NEED_BITRATE:
            expected = f"set for {interface}, as on the motors, e.g. {BITRATE}"
            raise ParameterError(f"{OPTIONS}.bitrate", bitrate, expected)
        kinds = [values["motor"][joint] for joint in motors]
        if is_fd(own) and (classic := [kind for kind in kinds if not MOTORS[kind].can_fd]):
            raise ParameterError(f"{OPTIONS}.fd", True, f"false: a {classic[0]} on this bus does not speak CAN FD")
        data_bitrate = own.get("data_bitrate", DATA_BITRATE) if is_fd(own) else 0
        boards = [format_of(values["motor"][joint], values["wire_format"][joint]) for joint in motors]
        replying = sum(board.replies for board in boards)
        traffic[name] = Traffic(replying, len(motors) - replying, bitrate or BITRATE, data_bitrate)
    return traffic


def is_fd(options: Mapping[str, Any]) -> bool:
    """Return whether a bus with these options of python-can carries our frames as CAN FD."""
    return options.get("fd") is True
