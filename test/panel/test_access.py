"""The token and the sessions that it opens; which host and origin a request may name."""

import pytest
from starlette.responses import PlainTextResponse

from exo_gravity.panel.access import ATTEMPT_WINDOW, ATTEMPTS, Access, is_loopback, is_same_origin


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def access_at(host, token="", clock=None):
    return Access(PlainTextResponse("never reached"), host, token, clock or Clock())


@pytest.mark.parametrize(
    ("host", "expected"),
    [
        ("127.0.0.1", True),
        ("127.8.9.1", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("192.168.1.4", False),
        ("127.0.0.1.example.org", False),
        ("", False),
    ],
)
def test_only_loopback_addresses_are_loopback(host, expected):
    assert is_loopback(host) is expected


def test_on_loopback_no_token_is_needed_and_elsewhere_a_random_one_is_made():
    assert access_at("127.0.0.1").is_open
    one, other = (access_at("0.0.0.0") for _ in range(2))
    assert not one.is_open
    assert len(one.token) >= 32
    assert one.token != other.token
    assert not access_at("127.0.0.1", "given").is_open


def test_without_a_token_only_a_loopback_name_may_be_asked_for():
    access = access_at("127.0.0.1")
    for host in ("127.0.0.1:8080", "localhost:8080", "[::1]:8080"):
        assert access.allows_host(host)
    for host in ("panel.example.org:8080", "", "127.0.0.1.example.org", "[bad"):
        assert not access.allows_host(host)
    assert access_at("0.0.0.0", "secret").allows_host("panel.example.org")


def test_the_cookie_is_not_the_token():
    access, other = (access_at("0.0.0.0", "secret") for _ in range(2))
    session = access.session
    assert len(session) >= 32 and session != other.session
    assert access.allows(session)
    for wrong in ("", "secret", session[:-1], session + "x", "ä"):
        assert not access.allows(wrong)


def test_wrong_tokens_block_their_address_for_a_while_and_no_other():
    clock = Clock()
    access = access_at("0.0.0.0", "secret", clock)
    for _ in range(ATTEMPTS):
        assert not access.is_token("wrong", "10.0.0.1")
    assert not access.is_token("secret", "10.0.0.1")
    assert access.is_token("secret", "10.0.0.2")
    clock.now += ATTEMPT_WINDOW + 1.0
    assert access.is_token("secret", "10.0.0.1")


def test_wrong_tokens_from_many_addresses_block_all():
    access = access_at("0.0.0.0", "secret")
    for n in range(10 * ATTEMPTS):
        access.is_token("wrong", f"10.0.1.{n}")
    assert not access.is_token("secret", "10.0.0.1")


@pytest.mark.parametrize(
    ("origin", "host", "expected"),
    [
        ("http://127.0.0.1:8080", "127.0.0.1:8080", True),
        ("https://panel.example.org", "panel.example.org", True),
        ("http://127.0.0.1:8081", "127.0.0.1:8080", False),
        ("http://evil.example.org", "127.0.0.1:8080", False),
        ("http://127.0.0.1:8080.evil.example.org", "127.0.0.1:8080", False),
        ("null", "127.0.0.1:8080", False),
        ("", "", False),
        ("file://127.0.0.1:8080", "127.0.0.1:8080", False),
    ],
)
def test_only_the_panels_own_page_has_its_origin(origin, host, expected):
    assert is_same_origin(origin, host) is expected
