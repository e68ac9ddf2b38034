# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""All estimates of the wearer of one arm, from one sample to the next: torque, share, contacts, support."""

import math
from collections.abc import Sequence

from exo_gravity.core.arm.rotation import Floats3
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.numbers import COVER
from exo_gravity.core.vocabulary import NONE, UNKNOWN, Adapts
from exo_gravity.lab.observer.adaptation import SupportAdaptation
from exo_gravity.lab.observer.contact import ContactWatch
from exo_gravity.lab.observer.momentum import MomentumObserver, WearerEstimate

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
        self, now: float, joints: Sequence[Sequence[float]] | None, trunk: tuple[Tilt, Floats3] | None
    ) -> WearerEstimate | None:
        """Take a sample of `now` s; return the estimate, None if there is none.

        joints: angles rad, velocities rad/s and the motors' efforts Nm, (n,) each; None if one is missing.
        trunk: tilt of what it feels as gravity, and its angular velocity (3,) rad/s in the arm's base frame; None if
        it is not known.
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
        values = values_of(self._names, estimate, self.adaptation.share if estimate else None)
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


def values_of(
    names: Sequence[str], estimate: WearerEstimate | None, share: tuple[float, float] | None
) -> dict[str, str]:
    """Return torques and share with half their 95 % bands, for /diagnostics.

    names: of the joints (n,). estimate: None if there is none. share: of the wearer, and its standard deviation, 0..1.
    """
    value, deviation = share or (None, 0.0)
    values = {"share of the wearer (%)": UNKNOWN, "share band (%)": UNKNOWN}
    if value is not None:
        values["share of the wearer (%)"] = f"{round(100.0 * value)}"
        values["share band (%)"] = f"{round(100.0 * COVER * deviation)}"
    for n, name in enumerate(names):
        values[f"{name} wearer (Nm)"] = f"{round(estimate.torque[n], 1) + 0.0:.1f}" if estimate else UNKNOWN
        values[f"{name} wearer band (Nm)"] = f"{COVER * estimate.deviation[n]:.1f}" if estimate else UNKNOWN
    return values


def _known_of(s: Settings) -> object:
    """Return what the observer depends on."""
    load = *s.wearer_mass, *s.wearer_cog, s.payload_mass, *s.payload_cog
    return s.robot, load, s.joint_spring, s.terms.friction, s.model_error
