# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The web server over real connections: what it refuses, and what it sends."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from starlette.responses import PlainTextResponse
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from exo_gravity.core.errors import ParameterError
from exo_gravity.panel.server import SERVING, Access, PanelServer

from ..support.panel_stage import Stage
from ..support.waiting import PATIENCE

TOKEN = "a token for this test"


@pytest.fixture(scope="module")
def shared() -> Iterator[Stage]:
    """A panel on loopback, for the whole module."""
    stage = Stage()
    yield stage
    stage.close()


@pytest.fixture
def stage(shared) -> Stage:
    """A panel on loopback with no calls to its arms yet, which may have had pages."""
    shared.arms.calls.clear()
    return shared


@pytest.fixture
def stages() -> Iterator[Callable[..., Stage]]:
    """A function that starts a panel, which ends with the test."""
    started: list[Stage] = []

    def start(**options: Any) -> Stage:
        started.append(Stage(**options))
        return started[-1]

    yield start
    for stage in started:
        stage.close()


@contextmanager
def live(stage: Stage, page: str = "", **headers: str) -> Iterator[ClientConnection]:
    """Open a live connection as a page does."""
    origin: Any = headers.pop("origin", stage.url.rstrip("/"))
    address = stage.url.replace("http", "ws") + "live"
    with connect(address, origin=origin or None, additional_headers=headers) as connection:
        connection.send(json.dumps({"page": page}))
        yield connection


def first(connection: ClientConnection, kind: str) -> dict[str, Any]:
    """Return the first message of this type."""
    while (message := json.loads(connection.recv(timeout=PATIENCE)))["type"] != kind:
        pass
    return message


def get(stage: Stage, path: str = "", **options: Any) -> httpx.Response:
    return httpx.get(stage.url + path, verify=False, **options)  # it takes long to read certificates


def act(stage: Stage, page: str = "", body: Any = None, **headers: str) -> httpx.Response:
    given = {"origin": stage.url.rstrip("/"), "x-panel-page": page, **headers}
    return httpx.post(stage.url + "action", json=body or {"do": "let_down"}, headers=given, verify=False)


def test_on_loopback_the_page_and_its_files_need_no_token_and_nothing_from_elsewhere(stage):
    page = get(stage)
    assert page.status_code == 200
    assert "http" not in page.text.replace("http-equiv", "")
    assert "'unsafe" not in page.headers["content-security-policy"]
    assert "frame-ancestors 'none'" in page.headers["content-security-policy"]
    assert page.headers["cache-control"] == "no-store"
    for path in ("static/main.js", "static/vendor/three.module.min.js", "static/vendor/three.LICENSE", "strings"):
        assert get(stage, path).status_code == 200
    for path in (
        "static/../server.py",
        "static/%2e%2e/server.py",
        "report/../../x",
        "report/none",
        "docs",
        "openapi.json",
    ):
        assert get(stage, path).status_code == 404


@pytest.mark.parametrize(
    ("host", "status"),
    [
        *((host, 200) for host in ("127.0.0.1:8080", "127.8.9.1", "localhost:8080", "[::1]:8080")),
        *((host, 403) for host in ("panel.example.org", "evil.example.org:80", "[bad", "0.0.0.0", "192.168.1.4")),
        ("127.0.0.1.example.org", 403),
    ],
)
def test_on_loopback_only_the_names_of_this_machine_are_answered(stage, host, status):
    assert get(stage, headers={"host": host}).status_code == status


FOREIGN = ("http://evil.example.org", "null", "", "http://127.0.0.1:1", "{own}.evil.example.org", "file://{host}")


@pytest.mark.parametrize("origin", FOREIGN)
def test_another_pages_requests_are_refused_even_to_let_down(stage, origin):
    own = stage.url.rstrip("/")
    origin = origin.format(own=own, host=own.removeprefix("http://"))
    assert act(stage, origin=origin).status_code == 403
    with pytest.raises(InvalidStatus), live(stage, origin=origin):
        pass
    assert stage.arms.calls == []


def test_behind_a_proxy_the_pages_origin_has_the_proxys_name(stages):
    stage = stages(token=TOKEN)
    proxied = {"host": "panel.example.org", "origin": "https://panel.example.org"}
    assert act(stage, **proxied).status_code == 401  # not 403: only the token is missing


def access_at(host: str, token: str = "", clock: Callable[[], float] = lambda: 0.0) -> Access:
    return Access(PlainTextResponse("never reached"), host, token, clock)


def test_elsewhere_than_on_loopback_a_random_token_is_made_unless_one_is_given():
    assert access_at("127.0.0.1").is_open and not access_at("127.0.0.1", TOKEN).is_open
    one, other = (access_at("0.0.0.0") for _ in range(2))
    assert not one.is_open and len(one.token) >= 32 and one.token != other.token


def test_wrong_tokens_block_their_address_for_a_while_and_those_of_many_addresses_block_all():
    now = 0.0
    access = access_at("0.0.0.0", TOKEN, lambda: now)
    for _ in range(SERVING.attempts):
        assert not access.is_token("wrong", "10.0.0.1")
    assert not access.is_token(TOKEN, "10.0.0.1") and access.is_token(TOKEN, "10.0.0.2")
    now += SERVING.attempt_window + 1.0
    assert access.is_token(TOKEN, "10.0.0.1")
    for n in range(10 * SERVING.attempts):
        access.is_token("wrong", f"10.0.1.{n}")
    assert not access.is_token(TOKEN, "10.0.0.1")


def test_without_the_token_nothing_is_served_and_with_it_everything(stages):
    stage = stages(token=TOKEN)
    for path in ("", "static/main.js", "strings", "parameters", "report/x"):
        answer = get(stage, path)
        assert answer.status_code == 401
        assert "main.js" not in answer.text
    assert act(stage).status_code == 401
    with pytest.raises(InvalidStatus), live(stage):
        pass
    assert stage.arms.calls == []
    origin = {"origin": stage.url.rstrip("/")}
    with httpx.Client(verify=False) as client:
        assert client.post(stage.url + "login", data={"token": "wrong"}, headers=origin).status_code == 401
        opened = client.post(stage.url + "login", data={"token": TOKEN}, headers=origin)
        assert opened.status_code == 303
        assert {"httponly", "samesite=strict"} <= set(opened.headers["set-cookie"].lower().replace(" ", "").split(";"))
        assert TOKEN not in opened.headers["set-cookie"]
        assert client.get(stage.url).status_code == 200
        ((name, session),) = client.cookies.items()
    assert len(session) >= 32
    for wrong in ("", TOKEN, session[:-1], session + "x"):
        assert get(stage, headers={"cookie": f"{name}={wrong}"}).status_code == 401
    cookie = {"cookie": f"{name}={session}"}
    assert act(stage, **cookie).status_code == 200
    with live(stage, **cookie) as connection:
        assert first(connection, "page")["number"] == 1


def test_the_address_with_the_token_opens_the_page_and_leaves_the_address(stages):
    stage = stages(token=TOKEN)
    opened = get(stage, params={"token": TOKEN})
    assert (opened.status_code, opened.headers["location"]) == (303, "/")
    assert get(stage, params={"token": "wrong"}).status_code == 401


def test_a_port_in_use_is_an_error_that_names_it(stage):
    with pytest.raises(ParameterError, match=f"{stage.port}.* must be a free address"):
        PanelServer("127.0.0.1", stage.port, "", stage.control)


def test_every_page_gets_setup_and_state_and_a_reloaded_page_stays_the_same(stages):
    stage = stages()
    with live(stage) as connection:
        page = first(connection, "page")
        setup = first(connection, "setup")
        assert set(setup["arms"]) == {"right", "left"}
        assert setup["language"] == "auto"
        assert setup["urdf"].count('type="revolute"') == 8
        state = first(connection, "state")
        assert len(state["arms"]["right"]["joints"]) == 4
        assert state["control"]["page"] == page["number"]
    with live(stage, page["page"]) as connection:
        assert first(connection, "page") == page


def test_the_settings_of_an_arm_are_read_when_they_are_asked_for(stages):
    stage = stages()
    stage.arms.settings["right"]["support"] = 0.4  # of which the pages have not heard yet
    assert get(stage, "settings/right").json()["settings"]["support"] == 0.4
    assert get(stage, "settings/middle").status_code == 404
    stage.arms.problem = "no answer"
    answer = get(stage, "settings/right")
    assert (answer.status_code, answer.json()) == (503, {"error": "no answer"})


def test_a_copied_page_replaces_the_first(stage):
    with live(stage) as one:
        secret = first(one, "page")["page"]
        with live(stage, secret) as other:
            first(other, "state")
            with pytest.raises(ConnectionClosed) as closed:
                while True:
                    one.recv(timeout=PATIENCE)
    assert closed.value.rcvd is not None and closed.value.rcvd.code == 4001


@pytest.mark.parametrize("hello", ["", "[]", "{", "{}", '{"page": 3}', "x" * 5000])
def test_a_live_connection_with_nonsense_ends_without_harm(stage, hello):
    with connect(stage.url.replace("http", "ws") + "live", origin=stage.url.rstrip("/")) as connection:
        connection.send(hello)
        with pytest.raises(ConnectionClosed):
            connection.recv(timeout=PATIENCE)
    assert act(stage).status_code == 200


LET_DOWN = b'{"do": "let_down"}'
BODIES = [
    (b"", 400),
    (b"{", 400),
    (b"[1", 400),
    (b"\xff", 400),
    (b"[" * 4000, 400),
    (LET_DOWN, 200),
    (LET_DOWN + b" " * 5000, 413),
]


@pytest.mark.parametrize(("content", "status"), BODIES)
@pytest.mark.parametrize("states_its_length", [True, False])
def test_only_a_request_that_is_json_and_short_is_carried_out(stage, content, status, states_its_length):
    given = content if states_its_length else iter((content[:9], content[9:]))
    answer = httpx.post(stage.url + "action", content=given, headers={"origin": stage.url.rstrip("/")}, verify=False)
    assert (answer.status_code, bool(stage.arms.calls)) == (status, status == 200)


def test_a_report_may_hold_styles_but_no_scripts(stage, tmp_path: Path):
    stage.files.reports["demo_1"] = tmp_path / "report.html"
    stage.files.reports["demo_1"].write_text("<p>held</p>")
    answer = get(stage, "report/demo_1")
    assert answer.status_code == 200
    assert "script-src" not in answer.headers["content-security-policy"]
    assert "default-src 'none'" in answer.headers["content-security-policy"]


def test_a_page_that_stops_confirming_no_longer_renews_its_lease(stages):
    stage = stages()
    with live(stage) as connection:
        first(connection, "page")
        for _ in range(3):
            connection.send(json.dumps({"seen": first(connection, "state")["number"]}))
        while len(stage.arms.leases) < 4:  # as it opened, and three confirmations
            first(connection, "state")
        for _ in range(3):
            first(connection, "state")  # the connection stays open, but the page is frozen
        assert stage.arms.leases == [("127.0.0.1 page 1", "hold")] * 4
