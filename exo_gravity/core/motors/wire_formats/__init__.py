"""The wire formats of AK motors, by the value of the parameter `wire_format`."""

from exo_gravity.core.motors.wire_formats.mit import MIT
from exo_gravity.core.motors.wire_formats.mit_v3 import MIT_V3
from exo_gravity.core.motors.wire_formats.wire_format import WireFormat

FORMATS: dict[str, WireFormat] = {MIT.name: MIT, MIT_V3.name: MIT_V3}

__all__ = ["FORMATS", "MIT", "MIT_V3", "WireFormat"]
