# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Who holds control, and for how long; and rates of counters."""

import pytest

from exo_gravity.core.numbers import Rate
from exo_gravity.core.safety.lease import LEASE_TIME, Lease


def held(name: str = "anna", now: float = 100.0) -> Lease:
    lease = Lease()
    assert lease.request(now, name, "hold") == f"{name} holds control"
    return lease


def test_a_lease_lasts_as_long_as_it_is_renewed_and_is_lost_once():
    lease, now = held(), 100.0
    for _ in range(10):
        now += 0.9 * LEASE_TIME
        assert lease.lost(now) == "" and lease.request(now, "anna", "hold") == ""
    assert lease.lost(now + LEASE_TIME) == ""
    assert lease.lost(now + 1.01 * LEASE_TIME) == "anna held control and has not renewed it for 1 s"
    assert lease.holder == "" and lease.lost(now + 60.0) == ""
    assert lease.request(now + 60.0, "ben", "hold") == "ben holds control"
    assert lease.request(now + 60.1, "ben", "release") == "ben has released control"
    assert Lease().lost(1e6) == lease.lost(1e6) == ""


def test_another_name_neither_holds_nor_renews_nor_releases_and_is_named_once():
    lease = held()
    for now in (100.2, 100.4, 100.6, 100.8):
        sentence = lease.request(now, "ben", "hold")
        assert sentence == ("ben may not hold control: anna does" if now == 100.2 else "")
    assert lease.request(100.9, "ben", "release") == ""
    assert lease.holder == "anna" and lease.lost(101.1)


def test_control_is_taken_on_request_and_who_had_it_does_not_get_it_back_by_holding_on():
    lease = held()
    assert lease.request(100.1, "ben", "take") == "ben has taken control from anna"
    assert lease.request(100.2, "anna", "hold") == "anna may not hold control: ben does"
    assert lease.request(100.9, "ben", "take") == "" and lease.holder == "ben"
    assert lease.lost(101.8) == "" and lease.lost(102.0)


@pytest.mark.parametrize(
    ("name", "kind"), [("", "hold"), ("x" * 65, "take"), ("an\nna", "take"), ("ben", "seize"), ("ben", "")]
)
def test_a_request_without_a_name_or_of_another_kind_does_nothing(name, kind):
    lease = held()
    assert lease.request(100.1, name, kind) == "control: needs a name of 1 to 64 letters and hold, take or release"
    assert lease.request(100.2, name, kind) == "" and lease.holder == "anna"


def test_a_rate_is_averaged_over_a_second_or_more_and_restarts_with_its_counter():
    rate = Rate()
    assert [rate.update(now, count) for now, count in ((10.0, 0), (10.5, 250), (11.0, 500), (11.1, 540))] == [
        0.0,
        0.0,
        500.0,
        500.0,
    ]
    assert rate.update(12.0, 3) == 0.0
    assert rate.update(14.0, 203) == 100.0
