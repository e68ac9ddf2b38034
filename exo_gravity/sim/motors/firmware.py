# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the firmwares of AK boards do that the wire format does not say: a record each.

Where the firmware of a family was not run or read, the record holds the worst case, and `assumed` names the field.

- `ak`: V1 and V2 boards as the manual V1.0.15 describes them and users report them: silent after SET_ZERO, without a
  time-out. What they do with a command while off is not known.
- `vendor`: the MIT image of a vendor's V1/V2 board (AK40-10), as it behaved in an emulator.
- `open_drive`: Ben Katz's drive (bgkatz/motorcontrol, `fsm.c` and `can.c`), of which the AK firmware is a descendant.
- `v3`: V3 boards by the manual V3.0.0, with the status rate that our documents ask for.
- `v3_2`: V3 boards with the image V3.2, as its files ship it.
- `v3_query`: the same in query-reply mode.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import MIT, MIT_V3
from exo_gravity.core.motors.frames import WireFormat
from exo_gravity.core.motors.joint_motor import MAX_STATUS_RATE
from exo_gravity.core.params import owned

FIRST_SPECIAL = 0xFC  # last byte of ENTER, the lowest special frame of the manual
BOOT_LOADER, CLEAR_FAULTS, QUERY = 0xFB, 0xF0, 0xEE  # last bytes of special frames of the vendor's image
WARM, SHUT_OFF = 2, 4  # bits of its error byte, which reads 2 and then 6
WARM_ABOVE, SHUT_OFF_AT = 81.0, 120.0  # degC at which it sets them
ENCODER_ERROR = 5  # MOTOR_ERRORS
REPLY_DELAY = (200e-6, 400e-6)  # s, as measured on AK motors
_NO_CONSTANTS: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True)
class Firmware:
    """One firmware. The defaults are what boards do of which only the frames are known. Raises ParameterError."""

    reply_to_master: bool = owned(False, "replies carry ID 0 instead of the motor's own")
    reply_length: int = 8  #: bytes: 6 without temperature and error, 7 without error
    zero_silence: float = (
        1.0  #: s for which the motor ignores frames after SET_ZERO (users report 0.5 to 1.5); 0: replies
    )
    #: Standard deviation of one reply.
    current_noise: float = owned(0.0, "noise of the torque in replies, as a share of it", (0.0, 0.5))
    status_rate: float = MAX_STATUS_RATE  #: status frames per s of a V3 board
    reply_delay: tuple[float, float] = REPLY_DELAY  #: s from the end of a command to its reply, at least and at most
    name: str = ""  #: the value of `firmware.variant`
    family: str = "ak"  #: of its motors
    wire_format: str = ""  #: the only one that it speaks; "" for any
    remembers_off: bool = True  #: a command while off is kept, and ENTER carries it out; otherwise it is ignored
    exit_clears: bool = False  #: EXIT clears the last command, which ENTER would resume
    zero_kept: bool = True  #: the zero of SET_ZERO survives a power cycle
    zero_while_on: bool = True  #: SET_ZERO is obeyed while the motor is on
    #: s without a command after which the torque and both gains go to 0 at once, until the next; 0: never. The motor
    #: stays on.
    timeout: float = 0.0
    error_is_mask: bool = False  #: bits WARM and SHUT_OFF, set by temperature; otherwise a code of MOTOR_ERRORS
    refuses_encoder_error: bool = True  #: with an encoder error the motor does not go on, and replies as ever
    position_range: float | None = None  #: rad on the wire; None for that of the motor's spec
    first_special: int = FIRST_SPECIAL  #: FF x 7 and this byte, or a higher one below FF, is no command
    id_bits: int = 11  #: of an 11-bit ID that are compared with the motor's
    shortest_command: int = (
        8  #: bytes; what is missing is left over from the frame before. 0: a remote frame is one too
    )
    retransmits: bool = True  #: its CAN controller sends a frame again after an error
    torque_per_ampere: Mapping[str, float] = _NO_CONSTANTS  #: Nm/A by motor; otherwise that of the motor's spec
    obeys_broadcast: bool = False  #: frames to ID 0xFF, V3 boards
    reports: bool = True  #: a V3 board sends its status unasked
    assumed: frozenset[str] = field(default=frozenset())  #: fields that are not known: the worst case

    def __post_init__(self) -> None:
        if self.reply_length not in (6, 7, 8):
            raise ParameterError("reply_length", self.reply_length, "6, 7 or 8 bytes")

    def check(self, wire_format: WireFormat) -> None:
        """Raise ParameterError if boards of `wire_format` never have this firmware."""
        if self.wire_format and not self._is_of(wire_format):
            own = [other.name for other in FIRMWARES.values() if other._is_of(wire_format)]
            expected = f"one of {', '.join(('usual', *own))} for a motor with wire_format = {wire_format.name}"
            raise ParameterError("firmware.variant", self.name, expected)

    def _is_of(self, wire_format: WireFormat) -> bool:
        return (self.family, self.wire_format) == (wire_format.family, wire_format.name)


AK = Firmware(
    name="ak",
    wire_format=MIT.name,
    assumed=frozenset(("remembers_off", "exit_clears", "refuses_encoder_error", "retransmits")),
)
VENDOR = Firmware(
    name="vendor",
    wire_format=MIT.name,
    zero_silence=0.0,
    remembers_off=False,
    zero_kept=False,
    error_is_mask=True,
    position_range=12.56,
    first_special=QUERY,
    shortest_command=0,
    assumed=frozenset(
        ("zero_silence", "zero_while_on", "refuses_encoder_error", "timeout", "shortest_command", "retransmits")
    ),
)
OPEN_DRIVE = Firmware(
    name="open_drive",
    reply_to_master=True,
    reply_length=7,
    reply_delay=(20e-6, 30e-6),
    wire_format=MIT.name,
    zero_silence=0.0,
    exit_clears=True,
    zero_kept=False,
    zero_while_on=False,
    timeout=0.025,
    refuses_encoder_error=False,
    id_bits=7,
    shortest_command=1,
    retransmits=False,
)
_V3_ASSUMED = frozenset(("refuses_encoder_error", "retransmits"))
V3 = Firmware(name="v3", wire_format=MIT_V3.name, assumed=_V3_ASSUMED | {"timeout"})
V3_2 = replace(
    V3,
    name="v3_2",
    timeout=0.1,
    status_rate=50.0,
    torque_per_ampere=MappingProxyType({"AK60-6": 0.2997}),
    obeys_broadcast=True,
    assumed=_V3_ASSUMED,
)
V3_QUERY = replace(V3_2, name="v3_query", reports=False, assumed=_V3_ASSUMED | {"reports"})
FIRMWARES = {firmware.name: firmware for firmware in (AK, VENDOR, OPEN_DRIVE, V3, V3_2, V3_QUERY)}
