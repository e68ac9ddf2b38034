# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""All estimates of the wearer of one arm, from one sample to the next: torque, share, contacts, support."""

import math
from collections.abc import Sequence

from exo_gravity.core.arm.rotation import Floats3
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.numbers import COVER
from exo_gravity.core.vocabulary import NONE, UNKNOWN
from exo_gravity.lab.observer.adaptation import SupportAdaptation
from exo_gravity.lab.observer.contact import ContactWatch
from exo_gravity.lab.observer.momentum import MomentumObserver, WearerEstimate
from exo_gravity.lab.observer.share import Known, Shares
from exo_gravity.lab.vocabulary import Adapts

OLD = 1.0  # s after which an estimate is no longer shown


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
    whole, joints = shares or (None, (None,) * len(names))
    values = dict(zip(("share of the wearer (%)", "share band (%)"), _percent(whole), strict=True))
    for name, share in zip(names, joints, strict=True):
        values[f"{name} share (%)"], values[f"{name} share band (%)"] = _percent(share)
    for n, name in enumerate(names):
        values[f"{name} wearer (Nm)"] = f"{round(estimate.torque[n], 1) + 0.0:.1f}" if estimate else UNKNOWN
        values[f"{name} wearer band (Nm)"] = f"{COVER * estimate.deviation[n]:.1f}" if estimate else UNKNOWN
    return values


def _percent(share: Known | None) -> tuple[str, str]:
    """Return a share and half its 95 % band."""
    if share is None:
        return UNKNOWN, UNKNOWN
    value, deviation = share
    return f"{round(100.0 * value)}", f"{round(100.0 * COVER * deviation)}"


def _known_of(s: Settings) -> object:
    """Return what the observer depends on."""
    load = *s.wearer_mass, *s.wearer_cog, s.payload
    worn = s.wearer_moments, s.tissue
    return s.robot, load, worn, s.joint_spring, s.joint_stiffness, s.terms.friction, s.model_error
