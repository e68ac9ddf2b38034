# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""All estimates of the wearer of one arm, from one sample to the next: torque, share, contacts, support.

A contact is a torque that comes faster than a person's does, as at a table's edge.
"""

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.arm.rotation import Floats3
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.numbers import COVER, Torque, for_joints
from exo_gravity.core.vocabulary import NONE, UNKNOWN
from exo_gravity.lab.observer.adaptation import SupportAdaptation
from exo_gravity.lab.observer.momentum import MomentumObserver, WearerEstimate, low_passed
from exo_gravity.lab.observer.share import Shares
from exo_gravity.lab.vocabulary import Adapts

OLD = 1.0  # s after which an estimate is no longer shown


@dataclass(frozen=True)
class ContactTuning:
    """What counts as a contact."""

    followed: float = 0.1  #: s, time constant of what a person's torque follows
    #: Nm beyond that, (n,): 1.3 times the most that `make study NAME=wearer` saw of reaching wearers
    least: Sequence[float] = (3.0, 5.0, 3.0, 1.5)
    pause: float = 1.0  #: s without another one, after which a contact is a new one


CONTACT = ContactTuning()


class ContactWatch:
    """Counts the contacts of one arm. last: time in s, joint and Nm of the newest, None before the first."""

    def __init__(self, tuning: ContactTuning = CONTACT) -> None:
        self.count = 0
        self.last: tuple[float, int, float] | None = None
        self._tuning = tuning
        self._slow: Torque = ()
        self._time = self._touched = -math.inf  # s

    def update(self, now: float, estimate: WearerEstimate) -> None:
        """Take the estimate at `now` s."""
        tuning = self._tuning
        dt, self._time = now - self._time, now
        if not 0.0 <= dt <= tuning.followed:
            self._slow, dt = estimate.torque, 0.0
        self._slow = low_passed(self._slow, estimate.torque, dt / tuning.followed)
        jumps = list(map(operator.sub, estimate.torque, self._slow))
        columns = zip(jumps, for_joints(tuning.least, len(jumps), max), estimate.distinguishable, strict=True)
        sizes = [abs(jump) / least if shown else 0.0 for jump, least, shown in columns]
        joint = max(range(len(sizes)), key=sizes.__getitem__)
        if sizes[joint] > 1.0:
            if now - self._touched > tuning.pause:
                self.count, self.last = self.count + 1, (now, joint, jumps[joint])
            self._touched = now


class WearerWatch:
    """The estimates of one arm. names: of the joints (n,). adaptation: of the support."""

    def __init__(self, names: Sequence[str], settings: Settings) -> None:
        self.adaptation = SupportAdaptation()
        self._names = names
        self._contact = ContactWatch()
        self._settings, self._observer = settings, MomentumObserver(settings)
        self._estimate: WearerEstimate | None = None
        self._time = -math.inf  # s, of the newest sample

    def apply(self, settings: Settings) -> None:
        """Use the compensator's new settings. The observer starts anew only if what it depends on has changed."""
        last, self._settings = self._settings, settings
        if _known_of(settings) != _known_of(last):
            self._observer = MomentumObserver(settings)

    def update(
        self, now: float, joints: Sequence[Sequence[float]] | None, trunk: tuple[Tilt, Floats3, Tilt] | None
    ) -> WearerEstimate | None:
        """Take a sample of `now` s; return the estimate, None if there is none.

        joints: angles rad, velocities rad/s and the motors' efforts Nm, (n,) each; None if one is missing.
        trunk: tilt of what it feels as gravity, its angular velocity (3,) rad/s in the arm's base frame, and tilt of
        gravity alone; None if it is not known.
        """
        self._time, self._estimate = now, None
        if joints is not None and trunk is not None:
            self._estimate = self._observer.update(now, joints, *trunk)
            self._contact.update(now, self._estimate)
        self.adaptation.update(now, joints and joints[:2], self._estimate, self._settings)
        return self._estimate

    def values(self, now: float) -> dict[str, str]:
        """Return torques and share with their 95 % bands, the newest contact, and the support, for /diagnostics."""
        estimate = self._estimate if now - self._time <= OLD else None
        values = values_of(self._names, estimate, self.adaptation.shares if estimate else None)
        requested, problem, contact = self.adaptation.requested, self.adaptation.problem, self._contact
        values |= {
            "support adapts": (Adapts.HELD if problem else Adapts.ON) if self._settings.is_adaptive else Adapts.OFF,
            "support adapts text": problem,
            "support asked for": NONE if requested is None else f"{requested:.3f}",
            "contacts": str(contact.count),
        }
        if contact.last is None:
            return values | dict.fromkeys(("contact joint", "contact torque (Nm)", "contact age (s)"), NONE)
        at, joint, jump = contact.last
        values["contact joint"], values["contact torque (Nm)"] = self._names[joint], f"{jump:.1f}"
        return values | {"contact age (s)": f"{now - at:.0f}"}


def values_of(names: Sequence[str], estimate: WearerEstimate | None, shares: Shares | None) -> dict[str, str]:
    """Return torques and shares with half their 95 % bands, for /diagnostics.

    names: of the joints (n,). estimate, shares: None if there are none.
    """
    unknown = (math.nan,) * len(names)
    (share, band), (of_joints, bands) = shares or ((math.nan, math.nan), (unknown, unknown))
    torques, deviations = (estimate.torque, estimate.deviation) if estimate else (unknown, unknown)
    values = {"share of the wearer (%)": _text(100.0 * share, 0), "share band (%)": _text(100.0 * COVER * band, 0)}
    columns = zip(names, of_joints, bands, torques, deviations, strict=True)
    for name, of_joint, its_band, torque, deviation in columns:
        values[f"{name} share (%)"] = _text(100.0 * of_joint, 0)
        values[f"{name} share band (%)"] = _text(100.0 * COVER * its_band, 0)
        values[f"{name} wearer (Nm)"] = _text(torque, 1)
        values[f"{name} wearer band (Nm)"] = _text(COVER * deviation, 1)
    return values


def _text(value: float | np.ndarray, digits: int) -> str:
    return UNKNOWN if math.isnan(value) else f"{round(float(value), digits) + 0.0:.{digits}f}"


def _known_of(s: Settings) -> object:
    """Return what the observer depends on."""
    load = *s.wearer_mass, *s.wearer_cog, s.payload
    worn = s.wearer_moments, s.tissue
    return s.robot, load, worn, s.joint_spring, s.joint_stiffness, s.terms.friction, s.model_error
