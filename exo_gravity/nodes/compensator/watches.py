"""What runs beside the control loop: the estimate of the wearer's torque, and the torque budget.

The control loop leaves its newest message to `WearerWatch`, and does not wait. If the estimate fails, the loop goes on,
and /diagnostics has the reason.

A budget takes about 0.2 s of arithmetic, on a thread of its own. The thread pauses after each millisecond: without
pauses, at any priority, it kept the control loop's threads from their processor for up to 0.1 s (measured, Linux 6.18,
two busy cores).
"""

import math
import os
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import JointState

from exo_gravity.core.arm.arm import STANDARD_GRAVITY, ArmModel
from exo_gravity.core.arm.budget import USUAL_TILT, budget, largest_support, motor_torques, overload, workspace
from exo_gravity.core.arm.kinematics import turning_in_base
from exo_gravity.core.arm.rotation import ZERO, Floats3
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trunk.inputs import FELT_RANGE
from exo_gravity.lab.observer.adaptation import SupportAdaptation
from exo_gravity.lab.observer.momentum import COVER, ContactWatch, MomentumObserver, WearerEstimate
from exo_gravity.nodes.ros.messages import by_name
from exo_gravity.nodes.ros.parameters import NodeParameters
from exo_gravity.nodes.ros.subscriptions import Repeated

PERIOD = 0.01  # s
FRESH = 0.1  # s, age of the trunk's motion that is used
Sample = tuple[float, Sequence[float], Sequence[float], float]  # monotonic s, m/s^2, rad/s, and age in s
PAUSE = 0.005  # s, about 500 times per budget
WITHIN = "within rated torque everywhere"
BRIDGE_PARAMETERS = {"motor", "torque_scale", "position_min", "position_max"}
Load = tuple[tuple[float, ...], tuple[float, ...]]  # the wearer's mass (4,) kg and centre of gravity (4,) m
Request = tuple[ArmModel, Load, float, float]  # robot, wearer, support 0..1, largest tilt in rad


class WearerWatch(Repeated):
    """Publishes `wearer_efforts` and `wearer_efforts_std` for each new sample, 100 times a second, on its own thread.

    newest: time in monotonic s and message of the joints; felt: the same of a sample of the trunk's motion: specific
    force (3,) m/s^2, angular velocity (3,) rad/s, age in s. Both are set by other threads. lock: guards `control`.
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
        self._known: object = None  # what the observer depends on
        self._due = 0.0
        self._last = -math.inf  # of the samples used
        self._estimate: WearerEstimate | None = None

    @property
    def values(self) -> dict[str, str]:
        """What /diagnostics says: torques and share with their 95 % bands, the newest contact, the support."""
        now, estimate, share = time.monotonic(), self._estimate, self._adaptation.share
        if now - self._last > 1.0:
            estimate = None
        torque = shared = "unknown"
        if self.failure:
            torque = f"failed: {type(self.failure).__name__}: {self.failure}"
        elif estimate:
            columns = zip(self._names, estimate.torque, estimate.deviation, estimate.distinguishable, strict=True)
            different = [f"{name} {tau:+.1f} +- {COVER * error:.1f}" for name, tau, error, shown in columns if shown]
            torque = ", ".join(different) or "not distinguishable from zero"
        if estimate and share:
            shared = f"{100.0 * share[0]:.0f} +- {100.0 * COVER * share[1]:.0f}"
        contact = "none"
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
        s = self._control.settings
        if s.mode != "zero_g" or not s.support_adapts:
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
        if message is None or taken <= self._last:
            return
        self._last = taken
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
        if estimate is None:
            return
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


class BudgetWatch:
    """Checks the newest settings, one budget at a time. Call `update` regularly.

    Motors and joint limits are parameters of `can_bridge`, which are read once.
    """

    def __init__(self, node: Node, joint_names: Sequence[str]) -> None:
        self.text = "unknown: waiting for can_bridge's parameters"  #: the result for the settings checked last
        #: share 0..1 of the wearer's arm within rated torque everywhere, 0 if none is, 'none' without a wearer
        self.largest_support = "unknown"
        self._logger = node.get_logger()
        self._names = tuple(joint_names)
        self._bridge = NodeParameters(node, "can_bridge", once=True)
        self._request: Request | None = None
        self._job: Future[tuple[str, str]] | None = None
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="budget")

    def update(self, settings: Settings) -> None:
        """Collect a finished budget, or start one for `settings` if they are new. Never blocks."""
        self._bridge.update()
        if self._job is not None:
            if self._job.done():
                (self.text, self.largest_support), self._job = self._job.result(), None
                if self.text != WITHIN:
                    self._logger.warning(f"{self.text}; efforts stay clamped to max_effort")
        elif self._bridge.values.keys() >= BRIDGE_PARAMETERS:
            s = settings
            load = tuple(s.wearer_mass), tuple(s.wearer_cog)
            support = (1.0 if s.support_adapts else s.support) if s.mode == "zero_g" else 0.0
            request = s.loaded, load, support, math.radians(USUAL_TILT) if s.use_imu else 0.0
            if request != self._request:
                self._request = request
                self._job = self._pool.submit(compute, self._names, request, self._bridge.values)


def compute(names: Sequence[str], request: Request, bridge: Mapping[str, Any]) -> tuple[str, str]:
    """Return `text` and `largest_support` of `BudgetWatch`, with pauses and without real-time scheduling.

    names: of the joints (4,). bridge: its parameter values.
    """
    # A thread inherits its creator's policy, and thread_priority sets that of all threads: never SCHED_FIFO here.
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    robot, load, support, tilt = request
    try:
        bounds = workspace(bridge["position_min"], bridge["position_max"], tilt)
        rated, peak = motor_torques(bridge["motor"], bridge["torque_scale"])
        joints = budget(robot, load, support, bounds, rated, peak, lambda: time.sleep(PAUSE))
    except ParameterError as error:
        return f"unknown: can_bridge has {error}", "unknown"
    return overload(names, joints) or WITHIN, f"{largest_support(joints) or 0.0:g}" if any(load[0]) else "none"
