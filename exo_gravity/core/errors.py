# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The errors that the package raises.

Each message names the item, its value and what would be valid.
"""

from collections.abc import Iterator
from contextlib import contextmanager


class ExoGravityError(Exception):
    """Base class of all errors below."""


class ParameterError(ExoGravityError, ValueError):
    """A parameter or argument is invalid.

    Attributes: `name` of the parameter, the rejected `value`, and `expected`, a description of valid values.
    """

    def __init__(self, name: str, value: object, expected: str) -> None:
        super().__init__(f"{name} = {_shown(value)}: must be {expected}")
        self.name = name
        self.value = value
        self.expected = expected


@contextmanager
def named(owner: str) -> Iterator[None]:
    """Put `owner`, with what separates it, before the name in any ParameterError raised inside the context."""
    try:
        yield
    except ParameterError as error:
        name = error.name if error.name.startswith(owner) else f"{owner}{error.name}"
        raise ParameterError(name, error.value, error.expected) from None


class FrameError(ExoGravityError, ValueError):
    """Bytes are not a valid frame. Attribute: `data`, the bytes."""

    def __init__(self, data: bytes | bytearray, expected: str) -> None:
        super().__init__(f"frame [{bytes(data).hex(' ')}]: must be {expected}")
        self.data = bytes(data)


class BusError(ExoGravityError):
    """The CAN bus cannot be opened, or sending or receiving on it failed."""


class DeviceError(ExoGravityError):
    """A sensor does not answer, is not the one expected, or has failed.

    Attributes: `device`, its name and address.
    """

    def __init__(self, device: str, problem: str) -> None:
        super().__init__(f"{device}: {problem}")
        self.device = device


class DataError(ExoGravityError):
    """A recording or a model file is missing, truncated or invalid."""


def _shown(value: object) -> str:
    text = repr(value.tolist() if hasattr(value, "tolist") else value)
    return text if len(text) <= 200 else text[:197] + "..."
