# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The node `panel` as a process with an arm that the test plays: its page, its parameters, what it asks of the arm."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from websockets.sync.client import ClientConnection, connect

from ..support.launched_nodes import executable
from ..support.node_thread import NodeThread
from ..support.ports import free_port
from ..support.ros_probe import RosProbe
from ..support.waiting import PATIENCE, wait_until

TOKEN = "a token for this test"
NAMES = [f"joint_{n}" for n in range(4)]
MAX_EFFORT = [9.0, 18.0, 9.0, 9.0]


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

    def close(self) -> None:
        self.process.kill()
        self.process.wait()


class PlayedArm:
    """`can_bridge` and `compensator` of the right arm.

    asked: what their services were asked for. leases: names and requests for control. holder: of control, as reported.
    """

    def __init__(self) -> None:
        self.leases: set[tuple[str, str]] = set()
        self.holder = "nobody"
        self.asked: list[tuple[str, Any]] = []
        self.lifecycle = State.PRIMARY_STATE_UNCONFIGURED
        self._thread = NodeThread("can_bridge", "compensator", namespace="right")
        self.bridge, self.compensator = self._thread.nodes
        self.close = self._thread.close
        self.bridge.declare_parameter("max_effort", MAX_EFFORT)
        self.compensator.declare_parameter("support", 0.1)
        self.bridge.create_service(SetBool, "~/enable", self._on_enable)
        self.bridge.create_service(Trigger, "~/clear_fault", self._on_clear_fault)
        self.bridge.create_service(GetState, "~/get_state", self._on_get_state)
        self.bridge.create_service(ChangeState, "~/change_state", self._on_change_state)
        self.bridge.create_subscription(KeyValue, "~/control", self._on_control, 10)
        self._states = self.bridge.create_publisher(JointState, "joint_states", 1)
        self._statuses = self.bridge.create_publisher(DiagnosticArray, "/diagnostics", 1)
        self.bridge.create_timer(0.05, self._publish)
        self._thread.start()

    def _publish(self) -> None:
        self._states.publish(JointState(name=NAMES, position=[0.1] * 4, velocity=[0.0] * 4, effort=[1.0] * 4))
        values = [KeyValue(key="state", value="disabled"), KeyValue(key="fault", value="none")]
        values.append(KeyValue(key="control held by", value=self.holder))
        # The panel decides by keys alone: this is no sentence of ours.
        status = DiagnosticStatus(name="right/can_bridge", message="zqx vw: kfj", values=values)
        self._statuses.publish(DiagnosticArray(status=[status]))

    def _on_control(self, message: KeyValue) -> None:
        self.leases.add((message.key, message.value))

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.asked.append(("enable", request.data))
        response.success = True
        return response

    def _on_get_state(self, request: GetState.Request, response: GetState.Response) -> GetState.Response:
        response.current_state = State(id=self.lifecycle, label="played")
        return response

    def _on_change_state(self, request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        self.asked.append(("change_state", request.transition.id))
        after = {
            (State.PRIMARY_STATE_UNCONFIGURED, Transition.TRANSITION_CONFIGURE): State.PRIMARY_STATE_INACTIVE,
            (State.PRIMARY_STATE_INACTIVE, Transition.TRANSITION_ACTIVATE): State.PRIMARY_STATE_ACTIVE,
        }.get((self.lifecycle, request.transition.id))
        response.success = after is not None
        self.lifecycle = after or self.lifecycle
        return response

    def _on_clear_fault(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.asked.append(("clear_fault", None))
        response.success, response.message = False, "refused: there is no fault"
        return response


@pytest.fixture
def stranger() -> Iterator[str]:
    """The name of a node of another program, which is called can_bridge too."""
    thread = NodeThread("can_bridge", namespace="truck")
    thread.nodes[0].declare_parameter("max_effort", "much")
    thread.start()
    yield "/truck/can_bridge"
    thread.close()


@pytest.fixture
def panel(tmp_path: Path) -> Iterator[PanelProcess]:
    """A panel on loopback whose page holds the arms' control."""
    panel = PanelProcess(tmp_path, dead_man=True)
    assert "on this machine only" in panel.wait_for_address()
    yield panel
    panel.close()


def message(connection: ClientConnection, kind: str, condition: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
    """Return the first message of this type for which `condition` holds."""
    while True:
        content = json.loads(connection.recv(timeout=PATIENCE))
        if content["type"] == kind and condition(content):
            return content


def is_known(setup: dict[str, Any], support: float = 0.1) -> bool:
    arm = setup["arms"].get("right")
    return bool(arm) and arm["max_effort"] == MAX_EFFORT and arm["settings"]["support"] == support


def test_the_page_shows_and_operates_an_arm_that_comes_and_goes_and_no_node_of_another_program(panel, stranger):
    origin = panel.url.rstrip("/")
    with connect(panel.url.replace("http", "ws") + "live", origin=origin) as connection:
        connection.send(json.dumps({"page": ""}))
        secret = message(connection, "page", lambda _: True)["page"]

        def ask(**body: Any) -> tuple[int, str]:
            headers = {"origin": origin, "x-panel-page": secret}
            answer = httpx.post(panel.url + "action", json=body, headers=headers, verify=False)
            return answer.status_code, answer.json()["error"]

        wait_until(lambda: stranger in httpx.get(panel.url + "parameters", verify=False).json())
        assert ask(do="let_down") == (409, "no arm is present")
        arm = PlayedArm()
        try:
            message(connection, "setup", is_known)
            state = message(connection, "state", lambda state: state["arms"]["right"]["joints"])["arms"]["right"]
            assert [joint["position"] for joint in state["joints"]] == [0.1] * 4
            name = f"panel {panel.process.pid}, 127.0.0.1 page 1"
            while (name, "hold") not in arm.leases:
                connection.send(json.dumps({"seen": message(connection, "state", lambda _: True)["number"]}))
            arm.holder = "anna"
            message(connection, "state", lambda state: state["control"]["elsewhere"] == "anna")
            assert ask(do="enable", arm="right") == (403, "enable right: anna holds control of this arm")
            assert ask(do="take") == (200, "")
            arm.holder = name
            message(connection, "state", lambda state: not state["control"]["elsewhere"])
            while (name, "take") not in arm.leases:
                message(connection, "state", lambda _: True)
            assert ask(do="enable", arm="right") == (200, "")
            assert ask(do="clear_fault", arm="right") == (409, "refused: there is no fault")
            for begin in (State.PRIMARY_STATE_UNCONFIGURED, State.PRIMARY_STATE_INACTIVE):
                arm.lifecycle = begin
                assert ask(do="activate", arm="right") == (200, "")
                assert arm.lifecycle == State.PRIMARY_STATE_ACTIVE
            refusal = "the bridge does not wait for its operator: it is played"
            assert ask(do="activate", arm="right") == (409, refusal)
            assert ask(do="set", arm="right", values={"support": 0.2}) == (200, "")
            answer = httpx.get(panel.url + "settings/right", verify=False)  # also before the panel has heard of it
            assert answer.json() == {"settings": {"support": 0.2}}
            message(connection, "setup", lambda setup: is_known(setup, 0.2))
            assert ask(do="let_down") == (200, "")
            steps = (Transition.TRANSITION_CONFIGURE, *[Transition.TRANSITION_ACTIVATE] * 2)
            activated = [("change_state", step) for step in steps]
            assert arm.asked == [("enable", True), ("clear_fault", None), *activated, ("enable", False)]
        finally:
            arm.close()
        message(connection, "state", lambda state: state["arms"]["right"]["bridge"] is None)
        assert ask(do="let_down") == (409, "right: /right/can_bridge/enable does not answer")


def test_its_parameters_can_be_read_but_not_its_token_and_it_ends_well(tmp_path):
    panel = PanelProcess(tmp_path, token=TOKEN)
    probe = RosProbe()
    try:
        assert TOKEN in panel.wait_for_address()
        assert httpx.get(panel.url, verify=False).status_code == 401
        assert httpx.get(panel.url, params={"token": TOKEN}, verify=False).status_code == 303
        values = probe.dump_parameters(["/panel"])["/panel"]["ros__parameters"]
        assert values["port"] == panel.port
        assert "token" not in values
        panel.process.terminate()
        assert panel.process.wait(PATIENCE) == 0
    finally:
        probe.close()
        panel.close()
