# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The tools' reader of parameter files against rcl's own: a real node that is given the same text."""

import math
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import ROS_PARAMETERS
from exo_gravity.hardware.network import restrict_to_localhost
from exo_gravity.lab.inputs import parameter_file
from exo_gravity.nodes.ros.parameters import plain

from ..support import CONFIG

restrict_to_localhost()

WRITTEN = (  # what people write, and what PyYAML and rcl read differently
    "5e-1", "5e3", "1E5", ".5", "5.", "+.5", "-0", "+7", "07", "08", "0x1F", "-0x10", "0x1p-2", "0o17", "1_000",
    "1:30", "y", "Y", "yes", "on", "On", "off", "n", "NO", "True", "TRUE", "tRUE", "~", "null", "Null", "2024-01-01",
    "=", "<<", ".inf", "-.inf", "+.INF", ".nan", "-.nan", "inf", "-Infinity", "nan", "NAN(1)", "1e400", "1e-400",
    "0e-400", "9223372036854775807", "-9223372036854775808", "9223372036854775808", "0xFFFFFFFFFFFFFFFFFF", "0x", "1e",
    "e5", "+", "'5'", '"yes"', "'~'", "!!str 5", "!!float 1", "!!bool '1'", "can0", "AK60-6", "a b", "'a: b'",
    '"\\u00e9"',
)  # fmt: skip


def is_plain(text: str) -> bool:
    """Return whether YAML reads a scalar in `key: text`, and nothing else."""
    try:
        events = list(yaml.parse(f"key: {text}", yaml.SafeLoader))
    except yaml.YAMLError:
        return False
    return len(events) == 8 and isinstance(events[4], yaml.ScalarEvent) and bool(events[4].value)


@pytest.fixture
def rcl(tmp_path: Path) -> Iterator[Callable[[str], dict[str, Any]]]:
    """A function that returns the parameters by name that the text gives a node '/right/tried'; rclpy raises errors."""
    contexts = []

    def read(text: str) -> dict[str, Any]:
        path = tmp_path / "params.yaml"
        path.write_text(text, encoding="utf-8")
        context = rclpy.Context()
        contexts.append(context)
        rclpy.init(args=["--ros-args", "--params-file", str(path)], context=context)
        node = rclpy.create_node(
            "tried", namespace="/right", context=context, automatically_declare_parameters_from_overrides=True,
            start_parameter_services=False,
        )  # fmt: skip
        found = {name: plain(parameter.value) for name, parameter in node.get_parameters_by_prefix("").items()}
        node.destroy_node()
        return {name: value for name, value in found.items() if name not in ROS_PARAMETERS}

    yield read
    for context in contexts:
        rclpy.try_shutdown(context=context)


def test_each_scalar_has_the_value_that_rcl_gives_it(rcl):
    dice = random.Random(46)
    drawn = (
        "".join(dice.choices("0123456789+-.eExXpaAfFnNiIyYoOsStTrRuUlL_:~", k=dice.randint(1, 6))) for _ in range(1000)
    )
    texts = [text for text in (*WRITTEN, *drawn) if is_plain(text) and not parameter_file.OCTAL.fullmatch(text)]
    assert len(texts) > 600 and set(WRITTEN) <= set(texts)
    lines = "\n".join(f"    p{number}: {text}" for number, text in enumerate(texts))
    text = f"/right/tried:\n  ros__parameters:\n{lines}\n"
    ours, theirs = parameter_file.read(text, "f")["/right/tried"], rcl(text)
    both = {text: (ours[f"p{number}"], theirs[f"p{number}"]) for number, text in enumerate(texts)}
    assert not {text: values for text, values in both.items() if repr(values[0]) != repr(values[1])}  # NaN is NaN


@pytest.mark.parametrize("name", ["exo.yaml", "sim.yaml", "sim_both.yaml"])
def test_a_packaged_file_and_what_the_launcher_makes_of_it_are_the_same_for_both(name, rcl):
    text = (CONFIG / name).read_text(encoding="utf-8")
    ours = parameter_file.read(text, name)
    for node, values in ours.items():
        for given in (text, parameter_file.text_of(ours)):
            theirs = rcl(given.replace(f"{node}:", "/right/tried:"))
            assert all(repr(value) == repr(theirs[parameter]) for parameter, value in values.items())


def test_texts_that_look_like_numbers_or_truth_values_come_back_as_texts(rcl):
    texts = ("5e-1", "y", "off", "0012", "~", "a: b", "é", "", "1\n2")
    values: dict[str, Any] = {f"p{number}": text for number, text in enumerate(texts)}
    values |= {"list": ["on", "1"], "number": 1e-05, "whole": 3, "infinite": math.inf, "truth": False}
    text = parameter_file.text_of({"/right/tried": values})
    assert parameter_file.read(text, "f") == {"/right/tried": values}
    theirs = rcl(text)
    assert all(repr(value) == repr(theirs[name]) for name, value in values.items())


ENTRY = "/right/tried:\n  ros__parameters:\n"
REFUSED = {  # a file, what is said of it, and whether rcl refuses it too, instead of reading what nobody means
    "node twice": (
        f"{ENTRY}    a: 1\n{ENTRY}    b: 2\n",
        r"f, line 4 = '/right/tried': must be given once: ",
        False,
    ),
    "key twice": (f"{ENTRY}    a: 1\n    a: 2\n", r"f, line 4 = '/right/tried a': .* line 3", False),
    "dotted twice": (f"{ENTRY}    a: {{b: 1}}\n    a.b: 2\n", r"f, line 4 = '/right/tried a\.b': .* line 3", False),
    "wildcards": (
        "/**:\n  ros__parameters: {a: 1}\n",
        r"node name = '/\*\*': must be the full name of one node.*line 1",
        False,
    ),
    "wildcard": (f"{ENTRY}    a: 1\n/*/tried:\n", r"node name = '/\*/tried'.*line 4", True),
    "deep wildcard": ("/**/tried:\n  ros__parameters: {a: 1}\n", r"node name = '/\*\*/tried'.*line 1", False),
    "anchor": (f"{ENTRY}    a: &x [1]\n", r"f, line 3 = '&x': must be written out", False),
    "alias": (f"{ENTRY}    a: [1]\n    b: *a\n", r"f, line 4 = '\*a'|undefined alias", True),
    "no value": (f"{ENTRY}    a:\n    b: 1\n", r"/right/tried a = None: .* \(line 3\)", True),
    "empty list": (f"{ENTRY}    a: []\n    b: 1\n", r"/right/tried a = \[\]: .* \(line 3\)", False),
    "two types": (f"{ENTRY}    a: [1, 2.5]\n", r"/right/tried a = \[1, 2\.5\]: must be a list of one type", True),
    "truth and text": (f"{ENTRY}    a: [yes, maybe]\n", r"a = \[True, 'maybe'\]: must be a list of one type", True),
    "list in list": (f"{ENTRY}    a: [[1], [2]]\n", r"/right/tried a = .*: must be a list of values \(line 3\)", False),
    "brackets in brackets": (f"{ENTRY}    a: {'[' * 100_000}\n", r"f, line 3 = 'brackets in brackets'", False),
    "no parameters": ("/right/tried:\n  ros__parameters:\n", r"f, line 2 = '/right/tried': must be a mapping", True),
    "two documents": (f"{ENTRY}    a: 1\n---\n{ENTRY}    b: 1\n", r"f, line \d = 'a second document'", False),
    "octal": (f"{ENTRY}    a: [1, 010]\n", r"f, line 3 = '/right/tried a 010': must be 10 or 8: ", False),
    "no name": ("/2nd/tried:\n  ros__parameters: {a: 1}\n", r"node name = '/2nd/tried': must be the full", False),
    "empty part": ("//tried:\n  ros__parameters: {a: 1}\n", r"node name = '//tried': must be the full", False),
    "not qualified": ("tried:\n  ros__parameters: {a: 1}\n", r"node name = 'tried': must be the full", False),
}


@pytest.mark.parametrize(("text", "said", "by_rcl"), REFUSED.values(), ids=REFUSED)
def test_what_nobody_means_is_refused_with_its_line(text, said, by_rcl, rcl):
    with pytest.raises((ParameterError, yaml.YAMLError), match=said):
        parameter_file.read(text, "f")
    if by_rcl:
        with pytest.raises(Exception, match="parse params file"):
            rcl(text)


def test_an_empty_mapping_at_which_rcl_ends_is_left_out_of_the_launchers_copy(rcl):
    text = f"{ENTRY}    can: {{interface: pcan, options: {{}}}}\n    b: 1\n"
    with pytest.raises(Exception, match="parse params file"):
        rcl(text)
    assert rcl(parameter_file.text_of(parameter_file.read(text, "f"))) == {"can.interface": "pcan", "b": 1}
