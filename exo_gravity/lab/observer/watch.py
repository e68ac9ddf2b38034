"""All estimates of the wearer of one arm, from one sample to the next: torque, share, contacts, support."""

import math
from collections.abc import Sequence

from exo_gravity.core.arm.rotation import Floats3
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.numbers import COVER
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
        share, torque, shared, contact = self.adaptation.share, "unknown", "unknown", "none"
        if estimate:
            columns = zip(self._names, estimate.torque, estimate.deviation, estimate.distinguishable, strict=True)
            different = [f"{name} {tau:+.1f} +- {COVER * error:.1f}" for name, tau, error, shown in columns if shown]
            torque = ", ".join(different) or "not distinguishable from zero"
        if estimate and share:
            shared = f"{100.0 * share[0]:.0f} +- {100.0 * COVER * share[1]:.0f}"
        if self._contact.last:
            at, joint, jump = self._contact.last
            ago = f"{min(99.0, now - at):.0f} s ago; {self._contact.count} in all"
            contact = f"{self._names[joint]} {jump:+.1f} Nm, {ago}"
        return {
            "wearer (Nm)": torque,
            "share of the wearer (%)": shared,
            "contact": contact,
            "support adapts": self._adaptation_text(),
        }

    def _adaptation_text(self) -> str:
        """Return from which support to which it adapts."""
        s, problem = self._settings, self.adaptation.problem
        if not s.is_adaptive:
            return "off"
        supports = (s.support, self.adaptation.requested or s.support)
        ends = dict.fromkeys(f"{100.0 * support:.0f}" for support in supports)
        return f"{' -> '.join(ends)} %{f', cannot rise: {problem}' if problem else ''}"


def _known_of(s: Settings) -> object:
    """Return what the observer depends on."""
    load = *s.wearer_mass, *s.wearer_cog, s.payload_mass, *s.payload_cog
    return s.robot, load, s.terms.friction, s.model_error
