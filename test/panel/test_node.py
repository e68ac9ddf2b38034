"""The node `panel` as a process, without a device: its page, its parameters, and its end."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest

from ..support.launched_nodes import executable
from ..support.ports import free_port
from ..support.ros_probe import RosProbe

TOKEN = "a token for this test"


class PanelProcess:
    """The process of a panel, which answers at `url`."""

    def __init__(self, folder: Path, **parameters: object) -> None:
        self.port = free_port()
        given = {"port": self.port, "output": str(folder), **parameters}
        options = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]
        self.url = f"http://127.0.0.1:{self.port}/"
        self.process = subprocess.Popen(
            [executable("panel"), "--ros-args", *options], stdout=sys.stderr, stderr=subprocess.PIPE, text=True
        )

    def wait_for_address(self) -> str:
        """Return the log line with the address."""
        assert self.process.stderr is not None
        return next(line for line in self.process.stderr if "http://" in line)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., PanelProcess]]:
    """A function that starts a panel, which ends with the test."""
    started: list[PanelProcess] = []

    def start(**parameters: object) -> PanelProcess:
        started.append(PanelProcess(tmp_path, **parameters))
        return started[-1]

    yield start
    for panel in started:
        panel.process.kill()
        panel.process.wait()


def test_its_parameters_can_be_read_but_not_its_token(start):
    panel = start(token=TOKEN)
    assert TOKEN in panel.wait_for_address()
    probe = RosProbe()
    try:
        values = probe.dump_parameters(["/panel"])["/panel"]["ros__parameters"]
        assert values["port"] == panel.port
        assert "token" not in values
    finally:
        probe.close()
    assert httpx.get(panel.url).status_code == 401
    assert panel.process.poll() is None


def test_on_loopback_it_answers_and_ends_well(start):
    panel = start()
    assert "on this machine only" in panel.wait_for_address()
    assert httpx.get(panel.url).status_code == 200
    panel.process.terminate()
    assert panel.process.wait(30) == 0


def test_beyond_loopback_it_prints_a_random_token_and_asks_for_it(start):
    panel = start(host="0.0.0.0")
    token = panel.wait_for_address().partition("?token=")[2].strip()
    assert len(token) >= 32
    assert httpx.get(panel.url).status_code == 401
    assert httpx.get(panel.url, params={"token": token}).status_code == 303


def test_a_port_in_use_is_an_error_with_a_sentence(start):
    first = start()
    first.wait_for_address()
    second = start(port=first.port)
    assert second.process.wait(60) == 2
    assert second.process.stderr is not None
    assert "must be a free address" in second.process.stderr.read()
