# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A motor bus is opened by the parameter file alone, and at the bit rate of the motors."""

from __future__ import annotations

import ast
from importlib.util import find_spec
from pathlib import Path

import can
import pytest
from can.interfaces import BACKENDS

from exo_gravity.core.motors.joint_motor import BITRATE, NEED_BITRATE
from exo_gravity.hardware.can.can_port import open_bus

THEIRS = {name: where for name, where in BACKENDS.items() if where[0].startswith("can.interfaces.")}


def sources(module: str) -> list[ast.Module]:
    """Return the sources of a backend of python-can, whose driver need not be installed."""
    path = Path(can.__file__).parent.joinpath(*module.split(".")[1:])
    files = [path.with_suffix(".py")] if path.with_suffix(".py").is_file() else sorted(path.parent.glob("*.py"))
    files = sorted(path.glob("*.py")) if path.is_dir() else files
    return [ast.parse(file.read_text(encoding="utf-8")) for file in files]


def default_bit_rates(module: str) -> list[object]:
    """Return the bit rates at which a backend opens a bus that is given none; None: that of its adapter."""
    found: list[object] = []
    for node in (node for tree in sources(module) for node in ast.walk(tree)):
        if isinstance(node, ast.FunctionDef) and node.name == "__init__":
            named = node.args.args + node.args.kwonlyargs
            values = [None] * (len(node.args.args) - len(node.args.defaults)) + node.args.defaults
            values += node.args.kw_defaults
            pairs = zip(named, values, strict=True)
            found += [value and ast.literal_eval(value) for argument, value in pairs if argument.arg == "bitrate"]
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "kwargs.get":
            key, *rest = node.args
            found += [ast.literal_eval(rest[0]) if rest else None] if ast.unparse(key) == "'bitrate'" else []
    return found


def test_a_bit_rate_must_be_given_where_python_can_would_take_another_one():
    assert find_spec("can") and len(THEIRS) > 20
    others = {name for name, (module, _) in THEIRS.items() if set(default_bit_rates(module)) - {BITRATE}}
    assert others == set(NEED_BITRATE)


CONFIGURED = "[default]\ninterface = slcan\nchannel = /dev/ttyUSB0\nbitrate = 500000\nreceive_own_messages = True\n"


def test_settings_of_another_project_do_not_reach_a_motor_bus(tmp_path, monkeypatch):
    (tmp_path / ".canrc").write_text(CONFIGURED)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("CAN_CONFIG", '{"receive_own_messages": true}')
    monkeypatch.setitem(can.rc, "receive_own_messages", True)
    bus = open_bus("virtual", "not_theirs", {})
    plain = can.Bus(interface="virtual", channel="not_theirs")
    assert plain.receive_own_messages and not bus.receive_own_messages  # python-can's own way takes them
    bus.shutdown()
    plain.shutdown()


@pytest.mark.parametrize(("channel", "number"), [("0", 0), ("can0", "can0"), ("239.74.163.2", "239.74.163.2")])
def test_a_channel_that_is_a_number_reaches_the_backend_as_one(channel, number):
    bus = open_bus("virtual", channel, {})
    other = can.Bus(interface="virtual", channel=number, ignore_config=True)
    other.send(can.Message(arbitration_id=1))
    assert bus.recv(1.0) is not None
    bus.shutdown()
    other.shutdown()
