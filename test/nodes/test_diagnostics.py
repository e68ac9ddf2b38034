# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Readable values on /diagnostics, and the aggregator's configuration."""

import math

import pytest
import yaml

from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.nodes.ros.messages import milliseconds, row

from ..support import CONFIG

REPORTING = ("can_bridge", "compensator", "simulator", "imu")


@pytest.mark.parametrize(
    ("values", "digits", "text"),
    [
        ((100.0, -0.0001, 2.0320), 3, "100, 0, 2.032"),
        ((99.6,), 0, "100"),
        ((math.nan, -1.25), 1, "nan, -1.2"),
        ((), 3, ""),
    ],
)
def test_numbers_have_few_digits_and_no_negative_zero(values, digits, text):
    assert row(values, digits) == text


def test_an_age_is_in_milliseconds_or_none():
    assert [milliseconds(0.0123), milliseconds(math.inf)] == ["12.3", "none"]


@pytest.mark.parametrize("file", ["exo.yaml", "sim.yaml", "sim_both.yaml"])
def test_the_aggregator_shows_each_reporting_node_once(file):
    analyzers = yaml.safe_load((CONFIG / "diagnostics.yaml").read_text())["analyzers"]["ros__parameters"]
    prefixes = [entry["startswith"] for entry in analyzers.values() if isinstance(entry, dict)]
    for node in load(CONFIG / file):
        if node.split("/")[-1] in REPORTING:
            assert sum(any(node.lstrip("/").startswith(prefix) for prefix in group) for group in prefixes) == 1, node
