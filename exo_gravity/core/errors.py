"""Every error that the package raises on purpose.

    ExoGravityError
    ├── ParameterError    a parameter or argument is impossible; nothing was changed
    ├── FrameError        bytes that an AK motor does not send or must not get
    ├── BusError          the CAN bus can't be opened, or failed
    └── DataError         a recording or a file does not hold what was asked of it

The message of each names the thing, its value and what would be right.
"""

from __future__ import annotations


class ExoGravityError(Exception):
    """Base of all errors below: catch it to catch what the package foresees."""


class ParameterError(ExoGravityError, ValueError):
    """A parameter is impossible.

    Attributes: `name` of the parameter, the `value` refused, and `expected`, what would be right.
    """

    def __init__(self, name: str, value: object, expected: str):
        super().__init__(f"{name} = {_shown(value)}: must be {expected}")
        self.name = name
        self.value = value
        self.expected = expected


class FrameError(ExoGravityError, ValueError):
    """Bytes are not the frame they should be. Attribute: `data`, the bytes."""

    def __init__(self, data: bytes, expected: str):
        super().__init__(f"frame [{bytes(data).hex(' ')}]: must be {expected}")
        self.data = bytes(data)


class BusError(ExoGravityError):
    """The CAN bus can't be opened, or sending or receiving on it failed."""


class DataError(ExoGravityError):
    """A recording or a model file is missing, cut short, or lacks what was asked of it."""


def _shown(value: object) -> str:
    text = repr(value.tolist() if hasattr(value, "tolist") else value)
    return text if len(text) <= 200 else text[:197] + "..."
