# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The web server over real connections: what it refuses, and what it sends."""

import asyncio
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import httpx
import pytest
from starlette.responses import PlainTextResponse
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from exo_gravity.core.errors import ParameterError
from exo_gravity.panel.recordings import Recordings
from exo_gravity.panel.server import SERVING, Access, PanelServer

from ..support.panel_stage import Stage
from ..support.waiting import PATIENCE, wait_until


def origin_of(stage: Stage) -> str:
    return stage.url.rstrip("/")


@contextmanager
def live(stage: Stage, hello: str = '{"page": ""}', **headers: str) -> Iterator[ClientConnection]:
    origin: Any = headers.pop("origin", origin_of(stage))
    with connect(
        stage.url.replace("http", "ws") + "live", origin=origin or None, additional_headers=headers
    ) as connection:
        connection.send(hello)
        yield connection


def first(connection: ClientConnection, kind: str) -> dict[str, Any]:
    while (message := json.loads(connection.recv(timeout=PATIENCE)))["type"] != kind:
        pass
    return message


def get(stage: Stage, path: str = "", **options: Any) -> httpx.Response:
    return httpx.get(stage.url + path, verify=False, **options)  # it takes long to read certificates


LET_DOWN = b'{"do": "let_down"}'


def act(stage: Stage, content: Any = LET_DOWN, **headers: str) -> int:
    """Ask for what `content` says; return the status."""
    return httpx.post(
        stage.url + "action", content=content, headers={"origin": origin_of(stage), **headers}, verify=False
    ).status_code


LOADED = ("static/main.js", "static/vendor/three.module.min.js", "static/vendor/three.LICENSE", "strings")
ELSEWHERE = ("static/../server.py", "static/%2e%2e/server.py", "report/../../x", "report/none", "docs", "openapi.json")


def test_on_loopback_the_page_and_its_files_need_no_token_and_nothing_from_elsewhere(stage):
    page = get(stage)
    policy = page.headers["content-security-policy"]
    assert page.status_code == 200 and "http" not in page.text.replace("http-equiv", "")
    assert "'unsafe" not in policy and "frame-ancestors 'none'" in policy
    assert page.headers["cache-control"] == "no-store"
    assert {get(stage, path).status_code for path in LOADED} == {200}
    assert {get(stage, path).status_code for path in ELSEWHERE} == {404}


OWN_HOSTS = ("127.0.0.1:8080", "127.8.9.1", "localhost:8080", "[::1]:8080")
OTHER_HOSTS = (
    "panel.example.org", "evil.example.org:80", "[bad", "0.0.0.0", "192.168.1.4", "127.0.0.1.example.org",
)  # fmt: skip
FOREIGN = ("http://evil.example.org", "null", "", "http://127.0.0.1:1", "{own}.evil.example.org", "file://{host}")


def test_only_the_names_of_this_machine_are_answered_and_no_other_pages_requests_not_even_to_let_down(stage):
    for hosts, status in ((OWN_HOSTS, 200), (OTHER_HOSTS, 403)):
        assert [get(stage, headers={"host": host}).status_code for host in hosts] == [status] * len(hosts)
    for origin in FOREIGN:
        foreign = origin.format(own=origin_of(stage), host=origin_of(stage).removeprefix("http://"))
        assert act(stage, origin=foreign) == 403
        with pytest.raises(InvalidStatus), live(stage, origin=foreign):
            pass
    assert stage.arms.calls == []


TOKEN = "a token for this test"


def access_at(host: str, token: str = "", clock: Callable[[], float] = lambda: 0.0) -> Access:
    return Access(PlainTextResponse("never reached"), host, token, clock)


def test_elsewhere_than_on_loopback_a_random_token_is_made_unless_one_is_given():
    assert access_at("127.0.0.1").is_open and not access_at("127.0.0.1", TOKEN).is_open
    one, other = (access_at("0.0.0.0") for _ in range(2))
    assert not one.is_open and len(one.token) >= 32 and one.token != other.token


def test_wrong_tokens_block_their_address_for_a_while_and_those_of_many_addresses_block_all():
    now = 0.0
    access = access_at("0.0.0.0", TOKEN, lambda: now)
    assert not any(access.is_token("wrong", "10.0.0.1") for _ in range(SERVING.attempts))
    assert not access.is_token(TOKEN, "10.0.0.1") and access.is_token(TOKEN, "10.0.0.2")
    now += SERVING.attempt_window + 1.0
    assert access.is_token(TOKEN, "10.0.0.1")
    for n in range(10 * SERVING.attempts):
        access.is_token("wrong", f"10.0.1.{n}")
    assert not access.is_token(TOKEN, "10.0.0.1")


def test_without_the_token_nothing_is_served_and_with_it_everything(locked):
    for path in ("", "static/main.js", "strings", "parameters", "report/x"):
        answer = get(locked, path)
        assert answer.status_code == 401 and "main.js" not in answer.text
    assert act(locked) == 401
    # Behind a proxy the page's origin has the proxy's name: it is not 403, only the token is missing.
    assert act(locked, host="panel.example.org", origin="https://panel.example.org") == 401
    with pytest.raises(InvalidStatus), live(locked):
        pass
    assert locked.arms.calls == []
    for given, status in (({"token": "wrong"}, 401), ({"token": TOKEN}, 303)):
        login = {"data": given, "headers": {"origin": origin_of(locked)}, "verify": False}
        posted, opened = httpx.post(locked.url + "login", **login), get(locked, params=given)
        assert posted.status_code == opened.status_code == status
    assert opened.headers["location"] == "/"  # the address loses the token
    cookie = posted.headers["set-cookie"]
    assert {"httponly", "samesite=strict"} <= set(cookie.lower().replace(" ", "").split(";")) and TOKEN not in cookie
    name, session = cookie.partition(";")[0].split("=", 1)
    assert len(session) >= 32
    for wrong in ("", TOKEN, session[:-1], session + "x"):
        assert get(locked, headers={"cookie": f"{name}={wrong}"}).status_code == 401
    own = {"cookie": f"{name}={session}"}
    assert get(locked, headers=own).status_code == act(locked, **own) == 200
    with live(locked, **own) as connection:
        assert first(connection, "page")["number"] == 1


def test_every_page_gets_setup_and_state_a_reloaded_page_stays_the_same_and_its_copy_replaces_it(stage):
    with pytest.raises(ParameterError, match=f"{stage.port}.* must be a free address"):
        PanelServer("127.0.0.1", stage.port, "", stage.control)
    with live(stage) as connection:
        page, setup, state = (first(connection, kind) for kind in ("page", "setup", "state"))
        assert set(setup["arms"]) == {"right", "left"} and setup["language"] == "auto"
        assert setup["urdf"].count('type="revolute"') == 8
        assert len(state["arms"]["right"]["joints"]) == 4
        assert state["control"]["page"] == page["number"]
        with live(stage, json.dumps({"page": page["page"]})) as copied:
            assert first(copied, "page") == page
            with pytest.raises(ConnectionClosed) as closed:
                while True:
                    connection.recv(timeout=PATIENCE)
    assert closed.value.rcvd is not None and closed.value.rcvd.code == 4001


def test_settings_are_read_when_they_are_asked_for_and_a_report_may_hold_styles_but_no_scripts(stage, tmp_path: Path):
    stage.arms.settings["right"]["support"] = 0.4  # of which the pages have not heard yet
    assert get(stage, "settings/right").json()["settings"]["support"] == 0.4
    assert get(stage, "settings/middle").status_code == 404
    stage.arms.problem = "no answer"
    answer = get(stage, "settings/right")
    assert (answer.status_code, answer.json()) == (503, {"error": "no answer"})
    stage.files.reports["demo_1"] = tmp_path / "report.html"
    stage.files.reports["demo_1"].write_text("<p>held</p>")
    answer = get(stage, "report/demo_1")
    policy = answer.headers["content-security-policy"]
    assert answer.status_code == 200 and "script-src" not in policy and "default-src 'none'" in policy


OPENED, UNLISTED = "P01/2026-03-14/demo; touch x_20260314_120000", "P01/2026-03-14/notes"
BOTH, HERE = ["PlotJuggler", "Foxglove"], "127.0.0.1"
ENVIRONMENT = {
    "PATH": "{0}/bin:/usr/bin:/bin",
    "AMENT_PREFIX_PATH": "{0}/none:{0}/ros",
    "DISPLAY": ":0",
    "WAYLAND_DISPLAY": "",
}
PROXIED = {"host": "panel.example.org", "origin": "http://panel.example.org"}
# By case: the client's address, what differs of its headers and of the panel's environment, an arm's state, and what
# differs of the request; the programs that are offered, and the status.
OPENINGS: dict[str, tuple[str, dict[str, str], dict[str, str], str | None, dict[str, Any], list[str], int]] = {
    "PlotJuggler": (HERE, {}, {}, "disabled", {}, BOTH, 200),
    "Foxglove": (HERE, {}, {}, "fault", {"program": "Foxglove"}, BOTH, 200),
    "from another computer": ("192.168.1.4", {}, {}, "disabled", {}, [], 403),
    "through a proxy on this one": (HERE, PROXIED, {}, "disabled", {}, [], 403),
    "by the page of another site": (HERE, {"origin": "https://evil.example.org"}, {}, "disabled", {}, BOTH, 403),
    "by a page that only watches": (HERE, {"x-panel-page": ""}, {}, "disabled", {}, BOTH, 403),
    "none is installed": (HERE, {}, {"PATH": "/usr/bin:/bin", "AMENT_PREFIX_PATH": ""}, "disabled", {}, [], 409),
    "no screen": (HERE, {}, {"DISPLAY": ""}, "disabled", {}, [], 409),
    "an arm is carried": (HERE, {}, {}, "active", {}, BOTH, 409),
    "an arm is silent": (HERE, {}, {}, None, {}, BOTH, 409),
    "a folder that is not listed": (HERE, {}, {}, "disabled", {"name": UNLISTED}, BOTH, 409),
    "no folder": (HERE, {}, {}, "disabled", {"name": ""}, BOTH, 409),
    "a path": (HERE, {}, {}, "disabled", {"name": f"{OPENED}/../../../{OPENED}"}, BOTH, 409),
    "no name": (HERE, {}, {}, "disabled", {"name": ["P01"]}, BOTH, 400),
    "another program": (HERE, {}, {}, "disabled", {"program": "sh"}, BOTH, 409),
}


@pytest.mark.parametrize(
    ("address", "headers", "environment", "state", "changes", "offered", "status"), OPENINGS.values(), ids=OPENINGS
)
def test_a_listed_recording_is_opened_in_a_program_on_this_computer_by_its_operator_while_the_arms_are_off(
    locked, tmp_path, monkeypatch, address, headers, environment, state, changes, offered, status
):
    for place in ("ros/lib/plotjuggler/plotjuggler", "bin/foxglove-studio"):
        (viewer := tmp_path / place).parent.mkdir(parents=True)
        viewer.write_text(
            f'#!/bin/sh\nprintf "%s\\n" "${{0##*/}}" "$@" > {tmp_path}/part\nmv {tmp_path}/part {tmp_path}/started\n'
        )
        viewer.chmod(0o755)
    for variable, value in {**ENVIRONMENT, **environment}.items():
        monkeypatch.setenv(variable, value.format(tmp_path))
    for name in (OPENED, UNLISTED):
        (bag := tmp_path / "out" / name / "bag").mkdir(parents=True)
        (bag / "bag_0.mcap").touch()
    device = Mock(**{"states.return_value": {"right": state, "left": "disabled"}})
    locked.control.files = Recordings(str(tmp_path / "out"), tmp_path, device, print, lambda: 0.0)
    own = {"origin": origin_of(locked), "x-panel-page": locked.control.open("", address).secret}

    async def asked() -> tuple[httpx.Response, httpx.Response]:
        transport = httpx.ASGITransport(locked.server.access, client=(address, 50000))
        async with httpx.AsyncClient(transport=transport, base_url=locked.url, headers=own) as browser:
            await browser.post("/login", data={"token": TOKEN})
            answer = await browser.post(
                "/action", headers=headers, json={"do": "open", "name": OPENED, "program": "PlotJuggler", **changes}
            )
            return await browser.get("/sessions", headers=headers), answer

    sessions, answer = asyncio.run(asked())
    assert (sessions.json()["programs"], answer.status_code) == (offered, status), answer.text
    if status == 200:
        wait_until((tmp_path / "started").exists)
        assert (tmp_path / "started").read_text().splitlines() == [
            *(["foxglove-studio"] if changes else ["plotjuggler", "-d"]),
            f"{tmp_path}/out/{OPENED}/bag/bag_0.mcap",
        ]
    assert (tmp_path / "started").exists() == (status == 200)


BODIES = [
    (b"", 400),
    (b"{", 400),
    (b"[1", 400),
    (b"\xff", 400),
    (b"[" * 4000, 400),
    (LET_DOWN + b" " * 5000, 413),
    (LET_DOWN, 200),
]


def test_only_a_request_that_is_json_and_short_is_carried_out_and_a_live_connection_with_nonsense_ends(stage):
    for hello in ("", "[]", "{", "{}", "x" * 5000):
        with live(stage, hello) as connection, pytest.raises(ConnectionClosed):
            connection.recv(timeout=PATIENCE)
    for content, status in BODIES:  # whose lengths are not stated
        assert stage.arms.calls == []
        assert act(stage, iter((content[:9], content[9:]))) == status
    assert stage.arms.calls
