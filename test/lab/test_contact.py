"""A contact is a torque that comes faster than a person's."""

from __future__ import annotations

import math

from exo_gravity.lab.observer.momentum import LEAST, ContactWatch, WearerEstimate

PERIOD, ELBOW = 0.01, 3


def touched(torques: list[float], deviation: float = 0.2) -> ContactWatch:
    """Return the watch after these torques of the elbow in Nm, 100 times a second."""
    watch = ContactWatch()
    for number, torque in enumerate(torques):
        estimate = WearerEstimate((0.0, 0.0, 0.0, torque), (deviation,) * 4, (0.0,) * 4)
        watch.update(PERIOD * number, estimate)
    return watch


def test_a_blow_is_a_contact_once_with_its_joint_and_sign():
    watch = touched([0.0] * 50 + [-4.0] * 100)
    assert watch.count == 1 and watch.last is not None
    time, joint, torque = watch.last
    assert (joint, torque < -LEAST[ELBOW]) == (ELBOW, True)
    assert abs(time - 0.5) < 0.02


def test_two_blows_more_than_a_second_apart_are_two_contacts():
    blow = [0.0] * 50 + [4.0] * 10
    assert touched([*blow, *[0.0] * 250, *blow]).count == 2


def test_a_torque_that_grows_as_a_persons_does_is_not_a_contact():
    assert touched([4.0 * math.sin(0.5 * math.pi * min(1.0, n / 150)) for n in range(300)]).count == 0


def test_within_the_band_nothing_is_a_contact():
    assert touched([0.0] * 50 + [4.0] * 100, deviation=3.0).count == 0


def test_a_gap_starts_anew():
    watch = touched([0.0] * 50)
    watch.update(10.0, WearerEstimate((0.0, 0.0, 0.0, 9.0), (0.1,) * 4, (0.0,) * 4))
    assert watch.count == 0
