# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Deliberate defects, each of which must turn a row of the fault matrix unsafe.

A defect replaces methods, properties or constants while a row is played, and is named for the behaviour that it breaks.
Where the package changes, the targets below follow; one that no longer exists is an error. What the watchdog, the lock
of a bus and the node can_bridge do has no defect here: test/hardware and test/nodes break it.
"""

import copy
import importlib
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

from exo_gravity.core.safety.command import Send
from exo_gravity.core.safety.watch import Power

STEP, MACHINE = (f"core.safety.machine:SafetyMachine.{name}" for name in ("step", "__init__"))
TRUSTED = "core.safety.watch:ArmWatch.trusted"  # zeros and signs
ARM_DESCENT, JOINT_DESCENT = (f"core.safety.descent:{name}" for name in ("ArmDescent", "JointDescent.__init__"))
DESCENT = "core.safety.descent:DESCENT"  # its tuning
DELIVERY = "core.safety.watch:JointWatch.judge_torque"
SENT = "core.safety.watch:SENT"  # what a motor is sent in each state
STALE, USED = (f"core.safety.explain:StaleEfforts.{name}" for name in ("step", "are_used"))
MONITOR, MOTION = "core.safety.explain:MotionMonitor.step", "core.safety.explain:MOTION"
WALL = "core.safety.shape:JointShaper._wall"
LEASE = "core.safety.lease:Lease.lost"
COMPENSATOR = "core.compensation.compensator:Compensator.step"
GUIDANCE = "core.compensation.load_change:GuidedChange.follow"
ASSIST_VALID, ASSIST = (f"core.compensation.terms.assist:AssistInput.{name}" for name in ("valid", "torque"))


def find(target: str) -> tuple[Any, str, Any]:
    """Return the module or class of a target, the attribute's name, and what it is; None for one of its instances'.

    Raises AttributeError if there is none.
    """
    module, _, path = target.partition(":")
    owner, (*parts, name) = importlib.import_module(f"exo_gravity.{module}"), path.split(".")
    for part in parts:
        owner = getattr(owner, part)
    if not hasattr(owner, name) and parts and name in vars(owner)["__init__"].__code__.co_names:
        return owner, name, None
    return owner, name, getattr(owner, name)


@dataclass(frozen=True)
class Defect:
    """A defect, and the names of the rows of which at least one must see it.

    patches: what replaces each target; called with what it replaces.
    """

    name: str
    rows: tuple[str, ...]
    patches: dict[str, Callable[[Any], Any]]

    @contextmanager
    def here(self) -> Iterator[None]:
        """Have the defect in this process for a while. Raises AttributeError."""
        with ExitStack() as stack:
            found = [(find(target), make) for target, make in self.patches.items()]
            for (owner, name, original), make in found:
                stack.enter_context(patch.object(owner, name, make(original), create=name not in vars(owner)))
            yield


def returns(result: Any) -> Callable[[Any], Any]:
    """Do nothing, and return `result`."""
    return lambda _: lambda *args, **options: result


def tuned(**fields: float) -> Callable[[Any], Any]:
    """Have these values in a record of tuning."""
    return lambda record: replace(record, **fields)


def always(value: Any) -> Callable[[Any], Any]:
    """Be an attribute that has this value, whatever is assigned."""
    return lambda _: property(lambda self: value, lambda self, assigned: None)


def after(change: Callable[..., Any]) -> Callable[[Any], Any]:
    """Return `change(result, self, *arguments)` in place of the method's result."""
    return lambda method: lambda self, *args, **options: change(method(self, *args, **options), self, *args)


def with_arguments(change: Callable[..., Any]) -> Callable[[Any], Any]:
    """Call the method with what `change(*arguments)` returns."""
    return lambda method: lambda self, *args, **options: method(self, *change(*args), **options)


def latching(_: Any) -> property:
    """Be an attribute that stays true once it is."""

    def assign(self: Any, value: bool) -> None:
        self.__dict__["latched"] = self.__dict__.get("latched", False) or value

    return property(lambda self: self.__dict__["latched"], assign)


def first_joint_only(applied: property) -> property:
    """Damp no other joint."""

    def damped(self: Any) -> Any:
        effort, (damping, *others) = applied.fget(self)  # type: ignore[misc]
        return effort, (damping, *[0.0] * len(others))

    return property(damped)


def off_after_a_fault(command: Any, machine: Any, *_: Any) -> Any:
    is_off, count = machine.state == "letting down" and machine.fault, len(command.effort)
    return type(command).off(count)._replace(send=(Send.EXIT,) * count) if is_off else command


def without_enter(command: Any, machine: Any, *_: Any) -> Any:
    if machine.state != "letting down":
        return command
    return command._replace(send=tuple(Send.COMMAND if send is Send.ENTER else send for send in command.send))


def replies_with_torque(judge: Callable[..., str]) -> Callable[..., str]:
    """Take a reply without torque for none."""

    def judge_torque(self: Any, *args: Any) -> str:
        sample = self.sample if abs(self.sample.effort) > 0.1 else self.sample._replace(time=-math.inf)
        with patch.object(self, "sample", sample):
            return judge(self, *args)

    return judge_torque


def without_timeout(limits: Any, *others: Any) -> Any:
    patient = copy.copy(limits)
    object.__setattr__(patient, "enable_timeout", math.inf)  # which a parameter may not be
    return patient, *others


def commands_unsure(sent: dict[Power, tuple[Send, Send]]) -> dict[Power, tuple[Send, Send]]:
    """Send ENTER, or to a V3 board a command, to a motor that may have lost its power."""
    return {**sent, Power.UNSURE: (Send.ENTER, Send.COMMAND)}


def used_on(fault: Any, stale: Any, *_: Any) -> None:
    stale.are_used = stale.are_used or fault is not None


def clamped(answer: Any, compensator: Any, *_: Any) -> Any:
    if answer.effort is None:
        return answer
    pairs = zip(answer.effort, compensator.settings.max_effort, strict=True)
    return answer._replace(effort=tuple(max(-most, min(most, torque)) for torque, most in pairs))


def remembered(torque: Callable[..., Any]) -> Callable[..., Any]:
    """Keep the torque while the efforts are not sound."""

    def remember(self: Any, now: float) -> Any:
        result = torque(self, now)
        if not self.reason:
            self.__dict__["remembered"] = result
        return self.__dict__.get("remembered", result)

    return remember


FAULT, FROZEN = "motor 2 reports an error", "compensator frozen, the rest runs on"
PRESSED = "compensator frozen while the wearer presses it down from the horizontal"
WRONG_SIGN = "effort of joint 2 with the wrong sign"
DEFECTS = (
    Defect("damping on one motor only", (FAULT,), {f"{ARM_DESCENT}.applied": first_joint_only}),
    Defect("EXIT at once on a fault", (FAULT,), {STEP: after(off_after_a_fault)}),
    Defect(
        "the torque does not fade",
        (FAULT,),
        {JOINT_DESCENT: with_arguments(lambda effort, damping, most: (0.0, damping, most))},
    ),
    Defect(
        "a motor that was switched off is not switched on again",
        ("foreign EXIT to motor 2 while let down", "motor 2 restarts in 30 ms"),
        {STEP: after(without_enter)},
    ),
    Defect(
        "a soft wall without damping",
        ("elbow pushed into the soft wall",),
        {WALL: after(lambda wall, *_: (wall[0], 0.0))},
    ),
    Defect("torque delivery is not checked", ("motor 2 restarts in 30 ms",), {DELIVERY: returns("")}),
    Defect(
        "a motor that replies no torque is taken for sound",
        ("motor 2 restarts in 30 ms",),
        {DELIVERY: replies_with_torque},
    ),
    Defect("stale efforts are accepted", (FROZEN,), {STALE: returns(None)}),
    Defect("stale efforts are used for ever", (FROZEN,), {STALE: after(used_on)}),
    Defect("stale efforts without damping", ("compensator stopped for 0.1 s",), {USED: always(False)}),
    Defect(
        "zeros once checked are always trusted",
        ("joint 2 jumps by a motor turn, then clear and enable",),
        {TRUSTED: latching},
    ),
    Defect(
        "motors are switched off while damping still holds the arm",
        ("arm disabled",),
        {f"{ARM_DESCENT}.is_down": lambda _: lambda self, *times: not any(self.applied[0])},
    ),
    Defect(
        "the brake of the descent grows without a bound",
        (PRESSED,),
        {
            DESCENT: tuned(brake_growth=math.inf),
            JOINT_DESCENT: with_arguments(lambda effort, damping, most: (effort, damping, 18.0)),
        },
    ),
    Defect(
        "the descent drives a joint that the wearer pushed down",
        (PRESSED,),
        {DESCENT: tuned(driven_speed=math.inf)},
    ),
    Defect(
        "the last effort of an outer loop that ended stays",
        ("outer loop stops",),
        {ASSIST_VALID: always(math.inf)},
    ),
    Defect(
        "the torque of an outer loop that has ended is remembered",
        ("outer loop stops, the next one asks for 0 Nm",),
        {ASSIST: remembered},
    ),
    Defect(
        "a change of load that ignores the joint's speed",
        ("Zero-G to One-G, 75 kg", "body mass 75 to 100"),
        {GUIDANCE: with_arguments(lambda dt, velocity, *loads: (dt, velocity and [0.0] * len(velocity), *loads))},
    ),
    Defect(
        "a clamp outside the guided change",
        ("max_effort 9 to 0.5 Nm, Zero-G, 75 kg",),
        {COMPENSATOR: after(clamped)},
    ),
    Defect("control that is not renewed is not lost", ("who holds control dies",), {LEASE: returns("")}),
    Defect(
        "powered frames are sent while the supply is cut",
        ("V3 boards: supply cut for 2 s", "supply cut for 2 s"),
        {SENT: commands_unsure},
    ),
    Defect(
        "an enable never expires",
        ("enabled, and the supply cut for 4 s while checking",),
        {MACHINE: with_arguments(without_timeout)},
    ),
    Defect(
        "unexplained torque is never a fault",
        (WRONG_SIGN, "efforts oscillate at 8 Hz"),
        {MONITOR: after(lambda result, *_: (result[0], None))},
    ),
    Defect(
        "unexplained torque is passed on, and takes ten times as long",
        (WRONG_SIGN,),
        {
            MONITOR: after(lambda result, self, dt, joints, effort, *_: (effort, result[1])),
            MOTION: tuned(patience=0.15),
        },
    ),
)  # fmt: skip
