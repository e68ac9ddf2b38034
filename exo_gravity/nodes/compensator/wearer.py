"""Estimates the wearer's torque 100 times a second, outside the control loop: `wearer_efforts`, `wearer_efforts_std`.

The control loop leaves its newest message here, and does not wait. Neither topic leads back to it; with
`support_adapts` the support follows, as a guided change every 2 s. If the estimate fails, the control loop goes on, and
/diagnostics has the reason.
"""

import math
import threading
import time
from collections.abc import Sequence

from rclpy.node import Node
from sensor_msgs.msg import JointState

from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.core.model.kinematics import turning_in_base
from exo_gravity.core.model.rotation import ZERO, Floats3
from exo_gravity.core.model.tilt import Tilt
from exo_gravity.core.observer.adaptation import SupportAdaptation
from exo_gravity.core.observer.contact import ContactWatch
from exo_gravity.core.observer.momentum import COVER, MAX_GAP, MomentumObserver, WearerEstimate
from exo_gravity.core.observer.share import RunningShare
from exo_gravity.core.trunk.inputs import FELT_RANGE
from exo_gravity.nodes.ros.messages import by_name
from exo_gravity.nodes.ros.subscriptions import Repeated

PERIOD = 0.01  # s
FRESH = 0.1  # s, age of the trunk's motion that is used
Sample = tuple[float, Sequence[float], Sequence[float], float]  # monotonic s, m/s^2, rad/s, and age in s


class WearerWatch(Repeated):
    """Publishes an estimate for each new sample, from a separate thread.

    newest: time in monotonic s and message of the joints; felt: time in monotonic s, specific force (3,) m/s^2,
    angular velocity (3,) rad/s and age of a sample of the trunk's motion. Both are set by other threads. lock: guards
    `control`.
    """

    def __init__(self, node: Node, names: Sequence[str], control: Compensator, lock: threading.Lock) -> None:
        super().__init__("wearer", self._tick, 0.0)
        self.newest: tuple[float, JointState | None] = (-math.inf, None)
        self.felt: Sample = (-math.inf, ZERO, ZERO, 0.0)
        self._names, self._control, self._lock = names, control, lock
        self._topics = [node.create_publisher(JointState, f"wearer_efforts{part}", 1) for part in ("", "_std")]
        self._message = JointState(name=names)  # one message, reused
        self._observer: MomentumObserver | None = None
        self._contact = ContactWatch()
        self._adaptation = SupportAdaptation()
        self._running = RunningShare()
        self._share: tuple[float, float] | None = None  # and its standard deviation
        self._known: object = None  # what the observer depends on
        self._due = 0.0
        self._last = -math.inf  # of the samples used
        self._estimate: WearerEstimate | None = None

    @property
    def values(self) -> dict[str, str]:
        """What /diagnostics says."""
        return {
            "wearer (Nm)": self._report_text(),
            "share of the wearer (%)": self._share_text(),
            "contact": self._contact_text(),
            "support adapts": self._adaptation_text(),
        }

    def _report_text(self) -> str:
        """Return the torque of each joint with its 95 % band."""
        estimate = self._estimate
        if self.failure:
            return f"failed: {type(self.failure).__name__}: {self.failure}"
        if estimate is None or time.monotonic() - self._last > 1.0:
            return "unknown"
        different = [
            f"{name} {torque:+.1f} +- {COVER * deviation:.1f}"
            for name, torque, deviation, shown in zip(
                self._names, estimate.torque, estimate.deviation, estimate.distinguishable, strict=True
            )
            if shown
        ]
        return ", ".join(different) or "not distinguishable from zero"

    def _share_text(self) -> str:
        """Return the wearer's share of his arm's weight over the last second, in percent with its 95 % band."""
        if self._share is None or self._estimate is None or time.monotonic() - self._last > 1.0:
            return "unknown"
        return " +- ".join(str(round(100.0 * part)) for part in (self._share[0], COVER * self._share[1]))

    def _contact_text(self) -> str:
        """Return the newest contact and how many there were."""
        if self._contact.last is None:
            return "none"
        at, joint, torque = self._contact.last
        ago = min(99.0, time.monotonic() - at)
        return f"{self._names[joint]} {torque:+.1f} Nm, {ago:.0f} s ago; {self._contact.count} in all"

    def _adaptation_text(self) -> str:
        """Return from which support to which it adapts."""
        s = self._control.settings
        if not isinstance(s, Settings) or s.mode != "zero_g" or not s.support_adapts:
            return "off"
        problem = "the estimate failed" if self.failure else self._adaptation.problem
        ends = dict.fromkeys(f"{100.0 * support:.0f}" for support in (s.support, s.support_now))
        return f"{' -> '.join(ends)} %{f', cannot rise: {problem}' if problem else ''}"

    def _tick(self) -> None:
        now = time.monotonic()
        self._due = max(self._due + PERIOD, now)
        time.sleep(self._due - now)
        taken, message = self.newest
        settings = self._control.settings
        if message is None or not isinstance(settings, Settings) or taken <= self._last:
            return
        dt, self._last = taken - self._last, taken
        trunk, joints = self._trunk(settings, taken), self._joints(message)
        estimate = None
        if trunk is not None and joints is not None:
            s = settings
            load = *s.wearer_mass, *s.wearer_cog, s.payload_mass, *s.payload_cog
            known = s.robot, load, s.terms.friction, s.model_error
            if self._observer is None or known != self._known:
                self._observer, self._known = MomentumObserver(settings), known
            estimate = self._observer.update(taken, joints, *trunk)
        self._estimate = estimate
        if self._adaptation.update(taken, joints and joints[:2], estimate, settings):
            with self._lock:
                self._control.raise_support(self._adaptation.support)
        if estimate is None or dt > MAX_GAP:
            self._running, self._share = RunningShare(), None
        if estimate is None:
            return
        self._share = self._running.update(min(dt, MAX_GAP), estimate)
        self._contact.update(taken, estimate)
        self._message.header.stamp = message.header.stamp
        for topic, effort in zip(self._topics, (estimate.torque, estimate.deviation), strict=True):
            self._message.effort = effort
            topic.publish(self._message)

    def _joints(self, message: JointState) -> list[tuple[float, ...]] | None:
        """Return positions, velocities and efforts (4,); None if one is missing."""
        try:
            return [by_name(message, field, self._names, exact=False) for field in ("position", "velocity", "effort")]
        except ParameterError:
            return None

    def _trunk(self, settings: Settings, now: float) -> tuple[Tilt, Floats3] | None:
        """Return the tilt of what the trunk feels as gravity, and its angular velocity; None if none is fresh."""
        if not settings.use_imu:
            return Tilt.of(settings.side), ZERO
        felt_at, force, rate, _ = self.felt
        if now - felt_at < FRESH and FELT_RANGE[0] < math.hypot(*force) < FELT_RANGE[1]:
            tilt = Tilt.of_felt(settings.side, [-component for component in force], STANDARD_GRAVITY)
            return tilt, turning_in_base(settings.side, rate)
        # Without the lock of the control loop: at worst a tilt is turned on by the angular velocity of the one before.
        tilt_input = self._control.tilt
        return None if tilt_input.problem(now) else (tilt_input.at(now), ZERO)
