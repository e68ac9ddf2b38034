# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A contact is a torque that comes faster than a person's."""

from __future__ import annotations

import math

import pytest

from exo_gravity.lab.observer.contact import ContactWatch
from exo_gravity.lab.observer.momentum import WearerEstimate

PERIOD, ELBOW = 0.01, 3
REST, BLOW = [0.0] * 50, [4.0] * 10  # Nm, 100 times a second
GROWING = [4.0 * math.sin(0.5 * math.pi * min(1.0, n / 150)) for n in range(300)]


def touched(torques: list[float], deviation: float = 0.2, gap: float = 0.0) -> ContactWatch:
    """Return the watch after these torques of the elbow in Nm. gap: s before the last one."""
    watch = ContactWatch()
    for number, torque in enumerate(torques, 1):
        now = PERIOD * number + gap * (number == len(torques))
        band = (deviation,) * 4
        watch.update(now, WearerEstimate((0.0, 0.0, 0.0, torque), band, (0.0,) * 4, band))
    return watch


def test_a_blow_is_a_contact_once_with_its_time_joint_and_sign() -> None:
    watch = touched([*REST, *[-4.0] * 100])
    assert watch.count == 1 and watch.last == (pytest.approx(0.5, abs=0.02), ELBOW, pytest.approx(-3.6, abs=0.4))


@pytest.mark.parametrize(
    ("torques", "deviation", "gap", "count"),
    [
        ([*REST, *BLOW, *[0.0] * 250, *REST, *BLOW], 0.2, 0.0, 2),
        (GROWING, 0.2, 0.0, 0),
        ([*REST, *BLOW], 3.0, 0.0, 0),
        ([*REST, 9.0], 0.1, 10.0, 0),
    ],
    ids=["two blows more than a second apart", "as a person's", "within the band", "after a gap"],
)
def test_only_a_blow_is_a_contact(torques: list[float], deviation: float, gap: float, count: int) -> None:
    assert touched(torques, deviation, gap).count == count
