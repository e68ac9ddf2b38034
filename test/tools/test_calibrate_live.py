# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the person at the terminal is shown, how the program waits for them, and how it follows the calibrator."""

from __future__ import annotations

import argparse
import io
import json
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest
from rich.console import Console

from exo_gravity.core.errors import BusError, DataError
from exo_gravity.hardware.ownership import bus_lock
from exo_gravity.lab.calibration.live import LiveTour, Person, run_tour
from exo_gravity.lab.inputs.parameter_file import can_options, load, packaged_config


@pytest.fixture
def keys() -> Iterator[tuple[IO[str], IO[str]]]:
    """The program's end of a pipe, and the person's."""
    reading, writing = os.pipe()
    with os.fdopen(reading) as program, os.fdopen(writing, "w") as person:
        yield program, person


def test_the_motors_are_watched_until_enter_is_pressed(keys: tuple[IO[str], IO[str]]) -> None:
    shown, watched = io.StringIO(), threading.Event()
    person = Person(Console(file=shown), keys[0])

    def watch() -> str:
        if not watched.is_set():
            watched.set()
            keys[1].write("\n")
            keys[1].flush()
        return "a table"

    person.wait("bend the elbow", watch)
    assert watched.is_set()
    assert "bend the elbow; then press Enter" in shown.getvalue()


def test_lines_are_printed_as_they_are_and_without_a_person_the_program_ends(keys: tuple[IO[str], IO[str]]) -> None:
    shown, line = io.StringIO(), "pose [3] of 12: " + 20 * "long "
    person = Person(Console(file=shown, width=40), keys[0])
    person.say(line)
    assert shown.getvalue() == f"{line}\n"
    keys[1].close()
    with pytest.raises(DataError, match="standard input"):
        person.wait("bow")


def test_lines_of_the_calibrator_are_followed_and_observations_are_kept(tmp_path: Path) -> None:
    record, said, tour = tmp_path / "new.jsonl", list[str](), LiveTour()
    values = {"theta": [0.0] * 4, "direction": [0, 0, 1], "effort": [1.0] * 4, "friction": [0.1] * 4}
    values |= {"spread": [0.01] * 4, "load_mass": 0.0, "load_lever": 0.0, "speed": 0.1}
    for event in ({"progress": "pose 1"}, {"observation": values}, {"trouble": "elbow: a hand"}, {"done": True}):
        tour.follow(json.dumps(event), record, said.append)
    tour.follow('{"half": ', record, said.append)
    assert said == ["pose 1"] and tour.trouble == "elbow: a hand" and tour.done
    assert tour.measured[0].speed == 0.1 and json.loads(record.read_text())["observation"] == values
    with pytest.raises(DataError, match=r"elbow: a hand; what was measured is kept in .*new.jsonl"):
        tour.complete(record)


def test_no_tour_begins_on_an_arm_that_a_running_bridge_may_carry(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(bus_lock, "FOLDERS", (tmp_path,))
    channel = f"tour{os.getpid()}"
    bridge = load(packaged_config("sim.yaml"))["/right/can_bridge"]
    lock = bus_lock.BusLock(("virtual", channel, can_options(bridge)), "/right/can_bridge (PID 7)")
    nodes = {"/right/can_bridge": {**bridge, "can.interface": "virtual", "can.channel": channel}}
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(BusError, match=r"held by /right/can_bridge \(PID 7\)"):
        run_tour(argparse.Namespace(output=tmp_path / "new.yaml", record=None), nodes, print)
    assert signal.getsignal(signal.SIGINT) is before
    lock.release()
