# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The node `panel` as a process with an arm that the test plays: its page, its parameters, what it asks of the arm."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import ListParameters
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from websockets.sync.client import connect

from ..support.launched_nodes import executable
from ..support.node_thread import NodeThread
from ..support.ports import free_port
from ..support.ros_probe import RosProbe
from ..support.waiting import PATIENCE, wait_until

TOKEN = "a token for this test"
NAMES = [f"joint_{n}" for n in range(4)]
MAX_EFFORT = [9.0, 18.0, 9.0, 9.0]


class PanelProcess:
    """The process of a panel, which answers at `url`, and a page of it without a browser, once `open` was called.

    address: the line of its log with its address.
    """

    def __init__(self, folder: Path, **parameters: object) -> None:
        self.port = free_port()
        given = {"port": self.port, "output": str(folder), **parameters}
        options = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]
        self.url = f"http://127.0.0.1:{self.port}/"
        self.process = subprocess.Popen(
            [executable("panel"), "--ros-args", *options], stdout=sys.stderr, stderr=subprocess.PIPE, text=True
        )
        self.address = next(line for line in self.process.stderr or () if "http://" in line)
        self.closing = ExitStack()

    def get(self, path: str = "", **options: Any) -> httpx.Response:
        return httpx.get(self.url + path, verify=False, **options)

    def open(self) -> None:
        self.headers = {"origin": self.url.rstrip("/")}
        live = connect(self.url.replace("http", "ws") + "live", origin=self.url.rstrip("/"))
        self.connection = self.closing.enter_context(live)
        self.connection.send(json.dumps({"page": ""}))
        self.headers["x-panel-page"] = self.message("page")["page"]

    def message(self, kind: str, condition: Callable[[dict[str, Any]], Any] = bool) -> dict[str, Any]:
        """Return the first message of this type for which `condition` holds."""
        while (content := json.loads(self.connection.recv(timeout=PATIENCE)))["type"] != kind or not condition(content):
            pass
        return content

    def ask(self, kind: str, **body: Any) -> tuple[int, str]:
        answer = httpx.post(self.url + "action", json={"do": kind, **body}, headers=self.headers, verify=False)
        return answer.status_code, answer.json()["error"]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., PanelProcess]]:
    panels: list[PanelProcess] = []

    def start(**parameters: object) -> PanelProcess:
        panels.append(PanelProcess(tmp_path, **parameters))
        return panels[-1]

    yield start
    for panel in panels:
        panel.closing.close()
        panel.process.kill()
        panel.process.wait()


class PlayedArm:
    """`can_bridge` and `compensator` of the right arm.

    asked: what their services were asked for. leases: names and requests for control. holder: of control, as reported.
    """

    def __init__(self) -> None:
        self.leases: set[tuple[str, str]] = set()
        self.holder = "nobody"
        self.asked: list[tuple[str, Any]] = []
        self.succeeds: Iterator[bool] = iter(())  # of the next transitions
        self._thread = NodeThread("can_bridge", "compensator", namespace="right")
        self.bridge, self.compensator = self._thread.nodes
        self.close = self._thread.close
        self.bridge.declare_parameter("max_effort", MAX_EFFORT)
        self.compensator.declare_parameter("support", 0.1)
        self.bridge.create_service(SetBool, "~/enable", partial(self._answer, "enable"))
        self.bridge.create_service(Trigger, "~/clear_fault", partial(self._answer, "clear_fault"))
        self.bridge.create_service(ChangeState, "~/change_state", self._on_change_state)
        self.bridge.create_subscription(KeyValue, "~/control", self._on_control, 10)
        self._states = self.bridge.create_publisher(JointState, "joint_states", 1)
        self._statuses = self.bridge.create_publisher(DiagnosticArray, "/diagnostics", 1)
        self.bridge.create_timer(0.05, self._publish)
        self._thread.start()

    def _publish(self) -> None:
        self._states.publish(JointState(name=NAMES, position=[0.1] * 4, velocity=[0.0] * 4, effort=[1.0] * 4))
        content = {"state": "disabled", "fault": "none", "control held by": self.holder}
        # The panel decides by keys alone: this is no sentence of ours.
        status = DiagnosticStatus(
            name="right/can_bridge",
            message="zqx vw: kfj",
            values=[KeyValue(key=key, value=value) for key, value in content.items()],
        )
        self._statuses.publish(DiagnosticArray(status=[status]))

    def _on_control(self, message: KeyValue) -> None:
        self.leases.add((message.key, message.value))

    def _answer(self, name: str, request: Any, response: Any) -> Any:
        self.asked.append((name, getattr(request, "data", None)))
        response.success, response.message = name == "enable", "refused: there is no fault"
        return response

    def _on_change_state(self, request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        self.asked.append(("change_state", request.transition.id))
        response.success = next(self.succeeds)
        return response


def is_known(setup: dict[str, Any], support: float = 0.1) -> bool:
    arm = setup["arms"].get("right")
    return bool(arm) and arm["max_effort"] == MAX_EFFORT and arm["settings"]["support"] == support


def test_the_page_shows_and_operates_an_arm_that_comes_and_goes_and_no_node_of_another_program(start):
    page, other = start(dead_man=True), NodeThread("can_bridge", namespace="truck")  # of another program
    other.nodes[0].declare_parameter("max_effort", "much")
    other.start()
    assert "on this machine only" in page.address
    page.open()
    wait_until(lambda: "/truck/can_bridge" in page.get("parameters").text)
    assert page.ask("let_down") == (409, "no arm is present")
    arm = PlayedArm()
    try:
        page.message("setup", is_known)
        shown = page.message("state", lambda state: state["arms"]["right"]["joints"])["arms"]["right"]
        assert [joint["position"] for joint in shown["joints"]] == [0.1] * 4
        name = f"panel {page.process.pid}, 127.0.0.1 page 1"
        while (name, "hold") not in arm.leases:
            page.connection.send(json.dumps({"seen": page.message("state")["number"]}))
        arm.holder = "anna"
        page.message("state", lambda state: state["control"]["elsewhere"] == "anna")
        assert page.ask("take") == (200, "")
        arm.holder = name
        page.message("state", lambda state: not state["control"]["elsewhere"] and (name, "take") in arm.leases)
        page.connection.send(json.dumps({"seen": page.message("state")["number"]}))
        assert page.ask("enable", arm="right") == (200, "")
        assert page.ask("clear_fault", arm="right") == (409, "refused: there is no fault")
        arm.succeeds = iter((True, True, False, True, False, False))  # of one that is unconfigured, inactive, active
        assert page.ask("activate", arm="right") == page.ask("activate", arm="right") == (200, "")
        assert "could not be activated" in page.ask("activate", arm="right")[1]
        assert page.ask("set", arm="right", values={"support": 0.2}) == (200, "")
        # Also before the panel has heard of it
        assert page.get("settings/right").json() == {"settings": {"support": 0.2}}
        arm.succeeds = (page.ask("let_down")[0] == 409 for _ in range(1))  # while the bridge opens its buses
        assert page.ask("activate", arm="right") == (409, "the arm was asked to be let down")
        page.message("setup", lambda setup: is_known(setup, 0.2))
        assert page.ask("let_down") == (200, "")
        activated = [
            ("change_state", Transition.TRANSITION_CONFIGURE),
            ("change_state", Transition.TRANSITION_ACTIVATE),
        ]
        assert arm.asked == [
            ("enable", True),
            ("clear_fault", None),
            *activated * 3,
            activated[0],
            *[("enable", False)] * 2,
        ]
    finally:
        arm.close()
        other.close()
    page.message("state", lambda state: state["arms"]["right"]["bridge"] is None)
    assert page.ask("let_down") == (409, "right: /right/can_bridge/enable does not answer")


def test_its_parameters_can_be_read_but_not_its_token_and_it_ends_well(start):
    panel = start(token=TOKEN)
    assert TOKEN in panel.address
    probe = RosProbe()
    names = probe.call(ListParameters, "/panel/list_parameters", ListParameters.Request()).result.names
    probe.close()
    assert "port" in names and "token" not in names
    panel.process.terminate()
    assert panel.process.wait(PATIENCE) == 0
