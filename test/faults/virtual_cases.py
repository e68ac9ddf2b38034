# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rows of the fault matrix that are played in virtual time: each fault, when it occurs, and what is allowed."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.motors.frames import SET_ZERO
from exo_gravity.core.safety.command import State
from exo_gravity.core.safety.limits import CONFIRM
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.sim.judge import USUAL, resolution
from exo_gravity.sim.rig import ACTS, IMU_PERIOD
from exo_gravity.sim.virtual_arm import TrunkReading

from ..support import CONFIG
from .fault_case import ALL_JOINTS, PAPER, PROCESS_REACTION, Action, Arm, FaultCase, acting, in_turn, pause
from .virtual import (
    CONNECT,
    CUT,
    CUT_OFF,
    END_SILENCE,
    ERROR,
    JUMP,
    NO_ERROR,
    RELEASE,
    RESTART,
    SHORT_RESTART,
    SILENCE,
    StruckArm,
    carries_again,
    change_efforts,
    clear,
    control_dies,
    device_from,
    enabled_in_vain,
    exit_frame,
    foreign,
    freeze,
    happens,
    power,
    random_frames,
    refused_on_the_wrong_angle,
    resume,
    resumed,
    struck,
)

Steps = Sequence[Mapping[str, Any]]

FOREIGN = -6.0  # Nm
OBSERVED = 3.0  # s after the supply returns
GAP = 4.0  # s for which motors are mute
BLIND = 30.0  # s, longer than a let-down waits for motors that do not reply
LAP = [0.1, 0.3, 0.3, 1.3]  # rad, near to hanging but for the elbow, which then reads 0.25
OFF = ("disabled",)
UNEXPLAINED = ("unexplained_torque",)
STALE = 0.5  # s from the fault, in which the motors have damped and are free again
TREMOR = 2.0  # Nm
STEADY = MOVED = GUIDED_SPEED = 0.6  # rad/s
MOTION = 8.0  # s until an arm that became heavy hangs
DROPPED, TAKEN = 2.0, 7.0  # kg, and s in which the motors take them
DROP_SPEED, LOAD_LOST = 4.8, 2.9  # rad/s of the paper's arm and of the elbow, below which no joint is a fault
# rad/s that a joint gains while its motor's own time-out has taken the torque away: 1.31 in 63 ms, and a loop that is
# stopped for 75 ms may miss one cycle more than that
FIRMWARE_FALL = 1.5
CARELESS = 1.5  # rad/s, where the replies are lost: nobody knows how fast the joints are
BOWING = 0.5  # rad/s
EMPTY = 0.35  # s from an empty cuff until the arm is let down
LET_DOWN = 1.5  # s from the death of who holds control
GONE_FOR = 0.45  # s from the fault, in which the assistance is out; that of a sound stream may then return
TOLERANCE = 0.08  # Nm
MAX_MOTION = 0.02  # rad
LET_GO = 0.35  # s, just after the time-out of the Damiao motors

UPRIGHT = {"trunk.pitch": 0.0, "trunk.roll": 0.0}
NO_IMU = {"use_imu": False}
SIGN_CHECK = {"sign_check_torque": 1.5}
PEAK = [9.0, 18.0, 9.0, 9.0]  # Nm
V3 = {"wire_format": ["mit_v3"] * 4}  # of the motors' boards
WORN_MASS, WORN_COG = Wearer(75.0).on_links((0.05, 0.13, 0.3, 0.3))
IN_IT = {"wearer.mass": WORN_MASS.tolist(), "wearer.cog": WORN_COG.tolist(), "friction.coulomb": [0.1] * 4}
ZERO_G = {"mode": "zero_g", "support": 1.0, "wearer.body_mass": 75.0}
_NODE = load(CONFIG / "sim.yaml")["/right/compensator"]
ROBOT = ArmModel(*(_NODE[name] for name in ("link_length", "robot.cog", "robot.mass")))

ALONE = Arm(compensator=NO_IMU, simulator=UPRIGHT)  # without an IMU
CHECKED = Arm(can_bridge=SIGN_CHECK)
SHORT_ENABLE = Arm(can_bridge={**SIGN_CHECK, "enable_timeout": 2.0})
EXCHANGED = Arm(
    can_bridge={**SIGN_CHECK, "can_id": [1, 2, 4, 3], "position_min": [-1.65, -0.5, -0.78, -0.5]},
)
# Zero-G for a wearer of 75 kg, who is passive. In this pose the rated torques carry the wearer's arm.
WORN = Arm(pose=(0.0, 0.4, 0.2, 0.5), compensator=ZERO_G, simulator=IN_IT)
WORN_V3 = replace(WORN, can_bridge=V3, simulator={**IN_IT, **V3})
# The same wearer with a load in the hand, for which the motors use their peak torque.
LOADED = replace(WORN, can_bridge={"max_effort": PEAK}, compensator={**ZERO_G, "max_effort": PEAK})
ASSISTING = (0.0, 0.25, 0.0, 0.0)  # Nm, less than the friction: with it and without it the arm rests
ASSISTED = replace(ALONE, compensator={**NO_IMU, "assist.max_effort": [1.0] * 4}, assisted=ASSISTING)
ON_V3 = Arm(can_bridge=V3, simulator=V3)
# The elbow's upper limit is within reach of a push, and far from the mechanical stop.
AT_WALL = Arm(pose=(0.0, 0.3, 0.3, 1.0), can_bridge={"position_max": [1.65, 3.14, 2.53, 1.2]})
WITH_TIMEOUT = Arm(simulator={"firmware.timeout": 0.025})
# In this pose the motors can hold the arm on a trunk that is bowed to any angle up to 110 degrees.
BOWED = Arm(pose=(0.0, 0.4, 1.0, 1.8))
# The bridge knows what the robot needs at most. Soon down: these rows are about what is refused.
MONITORED = Arm(
    pose=(0.0, 0.6, 0.0, 0.3),
    rate=100.0,
    can_bridge={"largest_moment": list(ROBOT.first_moment), "largest_addition": [0.0] * 4},
    compensator=NO_IMU,
    simulator=UPRIGHT,
)
COMMANDED = replace(MONITORED, can_bridge={})
# An arm half raised, which the wearer can move in both directions; and one with a long way to be pressed down.
HALF_RAISED = replace(ALONE, pose=(0.0, 0.9, 0.3, 0.6))
HIGH = replace(ALONE, pose=(0.0, 1.5, 0.3, 0.6))
ELBOW = Arm("elbow.yaml", pose=(1.3,), struck=0)
SEVEN = Arm("seven_joints.yaml", pose=(0.3, 1.1, 0.0, 0.4, 0.1, 0.1, -0.1))


def with_friction(coulomb: float, **other: Any) -> Arm:
    """Return an arm with this friction in Nm in every joint."""
    return Arm(
        simulator={"friction.coulomb": [coulomb] * 4, **{f"friction.{name}": each for name, each in other.items()}}
    )


BENT = replace(with_friction(0.01, viscous=[0.0] * 4), pose=(1.5, 1.5, -0.7, 2.4))
BENT = replace(BENT, simulator={**BENT.simulator, "trunk.pitch": 0.4, "trunk.roll": -0.3})
WEAK_MOTORS = Arm(can_bridge={"torque_scale": [0.6] * 4, "max_effort": [3.0, 9.0, 3.0, 3.0]})


def not_thrown_back(records: np.ndarray) -> str:
    """Return what is wrong if the elbow leaves the wall faster than a fifth of its speed into the wall.

    After this push, it leaves at 0.02 of that speed; at 0.30 where the wall has no damping.
    """
    velocity = records["velocity"][:, 3]
    inward = int(np.argmax(velocity))
    into, back = float(velocity[inward]), float(-velocity[inward:].min())
    if into < 1.0:
        return f"the push reached only {into:.1f} rad/s"
    return f"thrown back at {back:.1f} after {into:.1f} rad/s" if back > 0.2 * into else ""


def stays_off(records: np.ndarray) -> str:
    """Return what is wrong if a motor is on later than the cut."""
    on = records["on"][records["time"] > records["time"][0] + 0.1].any(axis=0)
    return f"motor {int(np.argmax(on)) + 1} was on after the cut" if on.any() else ""


def damped_for_a_moment(records: np.ndarray) -> str:
    """Return what is wrong unless every motor damps the motion for a moment, and then no more than before."""
    since, damping = records["time"] - records["time"][0], records["damping"]
    if damping[since < STALE].max(axis=0, initial=0.0).min() < 0.1:  # Nm s/rad
        return "ridden through without damping"
    return "still damped afterwards" if (damping[since > STALE] > damping[0] + 0.01).any() else ""


def within_max_effort(records: np.ndarray) -> str:
    """Return which joint was held with more than the rated torque, by default `max_effort`, damping apart; or ''."""
    effort = np.abs(records["torque"] + records["damping"] * records["velocity"]).max(axis=0)
    beyond = np.flatnonzero(effort > np.array([motor.rated_torque for motor in USUAL]) + resolution())
    return ", ".join(f"motor {joint + 1} holds with {effort[joint]:.1f} Nm" for joint in beyond)


def only_the_assistance_ends(records: np.ndarray, until: float = GONE_FOR) -> str:
    """Return what is wrong unless every motor keeps its torque without the assistance, and the arm rests.

    until: s after the fault in which the assistance must not return.
    """
    since = records["time"] - records["time"][0]
    gone = (since > PROCESS_REACTION) & (since < until)
    wrong = np.abs(records["torque"][gone] - (records["torque"][0] - ASSISTING))
    if wrong.max(initial=0.0) > TOLERANCE:
        return f"{wrong.max():.2f} Nm on top of gravity compensation, {1000 * PROCESS_REACTION:.0f} ms after the fault"
    motion = np.abs(records["position"] - records["position"][0]).max()
    return f"the arm moved by {motion:.2f} rad" if motion > MAX_MOTION else ""


@acting
def outer_loop(rig: Any, **changes: Any) -> None:
    """Change what an outer loop does."""
    for name, value in changes.items():
        setattr(rig.outer_loop, name, value)


def outer_loop_case(name: str, inject: Action, reason: str, **options: Any) -> FaultCase:
    """A row whose outer loop fails, and gravity compensation goes on without it: for a `reason`, '' if it returns."""

    def reports(rig: StruckArm) -> None:
        found = rig.assist.reason.code if rig.assist.reason else ""
        assert found == reason, f"assist reason: {found}"

    given = {"check": only_the_assistance_ends, "afterwards": reports, **options}
    return FaultCase(name, inject, ASSISTED, limit=None, outcomes=("active",), **given)


def expired(rig: StruckArm) -> None:
    """Check that the request to enable the arm has ended by itself."""
    assert rig.safety.refusal.text.startswith("not enabled within 2 s"), rig.safety.refusal


def load_is_withdrawn(rig: StruckArm) -> None:
    """Check that the compensator has noticed that the hand, or the cuff, is empty."""
    assert rig.compensator.lost


def await_refusal(rig: StruckArm) -> float:
    """Enable the arm until the start has failed; return when all motors were on: before, each is switched on once."""
    rig.between_cycles(rig.safety.enable)
    rig.run_until(lambda: all(motor.entered for motor in rig.motors), 30.0)
    start = rig.now
    rig.run_until(lambda: rig.state.value in ("fault", "disabled"), 30.0)
    return start


def connect_a_second_arm(rig: StruckArm) -> None:
    """Connect another arm, which hangs, to the bus, whose motors have the same IDs."""
    other = rig.wire.play(device_from(rig.nodes))
    rig.run_until(lambda: rig.fault, 30.0)
    rig.wire.ends.remove(other)


def take_and_drop(rig: StruckArm) -> float:
    """Take 2 kg into the hand, have them carried, let go of them; return when."""
    rig.act({"load": DROPPED, "over": 0.1}, {"move": list(rig.arm.pose), "over": TAKEN}, {"hold": 60.0})
    rig.set_parameters({"payload.mass": DROPPED})
    rig.run(TAKEN + 2.0)
    start = rig.now
    rig.act({"load": 0.0, "over": 60.0})
    rig.run(MOTION / 2.0)
    return start


def supply_case(name: str, *cut: Action, arm: Arm = PAPER, **options: Any) -> FaultCase:
    """A row whose arm falls, because it has no power, and whose motors must then be off for good."""
    return FaultCase(
        name,
        in_turn(*cut, RELEASE, pause(OBSERVED)),
        arm,
        unpowered=tuple(range(len(arm.pose))),
        steps_from=0.1,
        check=stays_off,
        afterwards=carries_again,
        **options,
    )


def while_wearer(does: str, steps: Steps, after: float, arm: Arm = HALF_RAISED, **options: Any) -> FaultCase:
    """The compensator freezes `after` s after the wearer began `steps`, and goes on with them."""

    def inject(rig: StruckArm) -> float:
        rig.act(*steps)
        rig.run(after)
        start = rig.now
        freeze(rig)
        return start

    return FaultCase(
        f"compensator frozen while the wearer {does}",
        inject,
        arm,
        limit=PROCESS_REACTION,
        clear=resume,
        outcomes=("command_stale",),
        driven_limit=MOVED,
        check=within_max_effort,
        **options,
    )


def load_case(name: str, change: Mapping[str, Any], back: Mapping[str, Any], arm: Arm = WORN) -> FaultCase:
    """A row whose operator changes the load, and changes it back."""

    def parameters(values: Mapping[str, Any]) -> Action:
        return lambda rig: rig.set_parameters(values)

    return FaultCase(
        name,
        in_turn(parameters(change), pause(MOTION)),
        arm,
        limit=None,
        outcomes=("active",),
        clear=in_turn(parameters(back), pause(MOTION / 2.0)),
        speed_limit=GUIDED_SPEED,
    )


def pushes(*torques: list[float]) -> Steps:
    """Push for a quarter of a second with each of these torques (4,) Nm: two opposite ones shake at 2 Hz."""
    return [{"push": torque, "over": 0.25} for torque in torques]


def second(change: Callable[[float, float], float]) -> Action:
    """Spoil the effort of joint 2: change(now, effort) gets s and Nm."""
    return change_efforts(lambda now, effort: (effort[0], change(now, effort[1]), *effort[2:]))


def stop_imu_for_a_moment(rig: StruckArm) -> None:
    """Stop the process that reads the IMU for 0.1 s, after which it sends the newest of what came meanwhile."""
    rig.imu_silent = True
    rig.run(0.1)
    rig.imu_silent = False
    assert rig.newest_reading
    rig.tell(rig.compensator, rig.newest_reading, rig.now - IMU_PERIOD / 2.0)


@acting
def bow(rig: StruckArm, pitch: float) -> None:
    """Let the trunk turn to `pitch` rad, farther than a trial script may bow, at BOWING."""
    count = round(abs(pitch - rig.device.pitch) / (BOWING * IMU_PERIOD))
    for number, angle in enumerate(np.linspace(rig.device.pitch, pitch, 1 + count).tolist()):
        rig.clock.later(number * IMU_PERIOD, partial(setattr, rig.device, "pitch", angle))


def unknown_states(rig: StruckArm) -> None:
    """Let the compensator read NaN for every angle."""
    take = rig.direct.take
    rig.direct.take = lambda now, samples: take(  # type: ignore[method-assign]
        now, [sample._replace(position=math.nan) for sample in samples]
    )


def stop_in_the_lap(rig: StruckArm) -> None:
    """Press the emergency stop, lay the arm in the lap, release it, clear the fault and enable; the wearer relaxes.

    The elbow's encoder has lost a turn, so that the arm seems to hang. The operator does not confirm that it does.
    """
    rig.safety.limits = replace(rig.safety.limits, start_pose=CONFIRM)
    CUT(rig)
    rig.act({"move": LAP, "over": 4.0}, {"move": LAP, "over": 60.0})
    rig.run(5.0)
    rig.run_until(lambda: rig.state is State.FAULT, BLIND)
    ACTS["encoder_slip"](rig, joint=3, error=-rig.motors[3].joint.spec.rotor_turn)
    RELEASE(rig)
    rig.run(1.0)
    clear(rig)
    rig.run(1.0)
    rig.between_cycles(rig.safety.enable)
    rig.run(GAP)
    rig.act()
    rig.run(GAP / 2.0)


def mute(*joints: int) -> Action:
    """Lose the replies of these motors for GAP s; the motors obey."""
    return in_turn(happens("mute", motors=joints, duration=GAP), pause(GAP))


def stopped(milliseconds: int) -> FaultCase:
    """Return the row of a bridge that stops for a moment, while its motors have a time-out."""
    return FaultCase(
        f"can_bridge stopped for {milliseconds} ms, motors with a time-out of 25 ms",
        happens("stall", duration=milliseconds / 1000.0),
        WITH_TIMEOUT,
        None,
        speed_limit=FIRMWARE_FALL,
        steps_from=math.inf,
    )


def rows_of(name: str, arm: Arm, lets_go: bool) -> tuple[FaultCase, ...]:
    """Return the rows of an arm that is not the paper's. lets_go: whether its motors have a time-out."""
    joints, own = tuple(range(len(arm.pose))), (arm.struck,)
    falls: dict[str, Any] = {"unpowered": joints, "damping_limit": math.inf} if lets_go else {}
    # fmt: off
    return (
        FaultCase(f"{name}: arm disabled", happens("disable"), arm, outcomes=OFF),
        FaultCase(f"{name}: a motor cut off from the bus", CUT_OFF, arm, clear=CONNECT, unreached=own,
            steps_from=math.inf, outcomes=("motor_silent",), **falls),
        FaultCase(f"{name}: a motor reports an error", ERROR, arm, clear=NO_ERROR, afterwards=carries_again,
            outcomes=("motor_error",), steps_from=0.05 if lets_go else 0.0, **falls),
        FaultCase(f"{name}: bus silent for 3 s", in_turn(SILENCE, pause(3.0), END_SILENCE), arm, unreached=joints,
            steps_from=LET_GO if lets_go else 0.0, outcomes=("motor_silent",), **falls),
        supply_case(f"{name}: supply cut for 2 s", CUT, pause(2.0), arm=arm),
        FaultCase(f"{name}: foreign 6 Nm to a motor, 500 a second for 2 s", foreign(FOREIGN), arm, steps_from=2.1,
            outcomes=("foreign_command",), energy_limit=2.0),
        FaultCase(f"{name}: a joint jumps by a motor turn, then clear and enable", JUMP, arm,
            afterwards=refused_on_the_wrong_angle, outcomes=("position_jump", "over_speed")),
        FaultCase(f"{name}: compensator frozen, the rest runs on", freeze, arm, clear=resume,
            outcomes=("command_stale",)),
    )
    # fmt: on


LIFT: Steps = [{"move": [0.0, 1.5, 0.3, 1.2], "over": 1.6}]
PUSH_DOWN: Steps = [{"move": [0.0, 0.3, 0.1, 0.3], "over": 1.0}]
PRESS_DOWN: Steps = [{"move": [0.0, 0.4, 0.2, 0.4], "over": 1.6}]
KEEP: Steps = [{"move": list(HALF_RAISED.pose), "over": 5.0}]
SHAKE = pushes(*[[0.0, 2.0, 0.8, 0.3], [0.0, -2.0, -0.8, -0.3]] * 10)
THROW = pushes([0.0, 2.5, 0.0, 0.2])
REACH_OUT: Steps = [{"move": pose, "over": 1.2} for pose in ([0.3, 1.2, 0.8, 1.2], list(WORN.pose))]
REACH: Steps = [{"move": pose, "over": 0.8} for pose in ([0.3, 1.2, 0.8, 1.2], list(HALF_RAISED.pose)) * 4]
WALL_PUSH: Steps = [{"push": [0.0, 0.0, 0.0, 0.5], "over": 0.2}, {"hold": 600.0}]
SPRING = {"spring.stiffness": [4.0, 14.0, 7.0, 3.8], "spring.pose": [0.0, 0.0, -0.3, 1.3]}
WEAK, RATED = {"max_effort": [0.5] * 4}, {"max_effort": [3.0, 9.0, 3.0, 3.0]}
# fmt: off
MOTORS = (
    FaultCase("arm disabled", happens("disable"), PAPER, outcomes=OFF),
    # Reached again so late, a motor drops what it held at the first command, under full damping: its motion is judged.
    FaultCase("motor 2 cut off from the bus", CUT_OFF, PAPER, clear=CONNECT, unreached=(1,), steps_from=math.inf,
        outcomes=("motor_silent",)),
    # The joint falls onto its mechanical stop: for 2 ms the other motors' damping opposes an impact of 3 to 5 rad/s.
    FaultCase("motor 2 without power", power(False, 1), PAPER, clear=RELEASE, unpowered=ALL_JOINTS, steps_from=0.05,
        damping_limit=math.inf, outcomes=("motor_silent",)),
    FaultCase("motor 2 restarts in 30 ms", RESTART, PAPER, steps_from=0.3,
        outcomes=("torque_not_delivered", "motor_silent")),
    FaultCase("bus silent until the arm is given up", SILENCE, PAPER, clear=END_SILENCE, unreached=ALL_JOINTS,
        steps_from=math.inf, outcomes=("motor_silent",)),
    FaultCase("joint 2 jumps by a motor turn, then clear and enable", JUMP, PAPER,
        afterwards=refused_on_the_wrong_angle, outcomes=("position_jump", "over_speed")),
    FaultCase("foreign EXIT to motor 2, once", exit_frame, PAPER, steps_from=0.05,
        outcomes=("foreign_command", "torque_not_delivered")),
    FaultCase("foreign SET_ZERO to motor 2, once",
        lambda rig: rig.send((rig.motors[rig.struck].joint.command_id, SET_ZERO)), PAPER, unreached=(1,),
        steps_from=0.05),
    FaultCase("foreign 6 Nm to motor 2, 500 a second for 2 s", foreign(FOREIGN), PAPER, steps_from=2.1,
        outcomes=("foreign_command",), energy_limit=2.0),  # the foreign torque does work until opposed
    FaultCase("random frames", in_turn(random_frames((0, *range(5, 2048))), pause(2.0)), PAPER, None,
        outcomes=("active",)),  # 1 to 4: the motors
    FaultCase("imu silent", happens("imu_silent"), PAPER, limit=PROCESS_REACTION),
)
DESCENT = (
    FaultCase("enabled again while let down", happens("enable"), PAPER, stage="letting down", outcomes=OFF),
    FaultCase("motor 2 cut off for 2 s while let down", in_turn(CUT_OFF, pause(2.0), CONNECT), PAPER,
        stage="letting down"),
    # While it is without power the arm falls freely: 0.3 rad/s in 15 ms, on top of the descent's speed.
    FaultCase("motor 2 restarts in 15 ms while let down", SHORT_RESTART, PAPER, stage="letting down", steps_from=0.3),
)
START = (
    FaultCase("motor 2 reports an error while checking", ERROR, CHECKED, stage="checking", clear=NO_ERROR,
        outcomes=("motor_error",)),
    FaultCase("motor 2 cut off while checking", CUT_OFF, CHECKED, stage="checking", clear=CONNECT,
        outcomes=("checking",)),
    FaultCase("motor 2 cut off while proving", CUT_OFF, CHECKED, stage="proving signs", clear=CONNECT, unreached=(1,),
        outcomes=("motor_silent",)),
    FaultCase("joint 2 jumps by a motor turn while proving", JUMP, CHECKED, stage="proving signs",
        # The encoder has lost a turn of the rotor.
        clear=happens(
            "encoder_slip", joint=struck, error=lambda rig: -rig.motors[rig.struck].joint.spec.rotor_turn
        ),
        outcomes=("position_jump", "over_speed")),
    FaultCase("foreign EXIT to motor 2 while proving", exit_frame, CHECKED, stage="proving signs", steps_from=0.05),
    # A hanging arm needs hardly any torque, so that none is missed.
    FaultCase("motor 2 restarts while ramping in", RESTART, CHECKED, None, "ramping in", steps_from=0.3,
        outcomes=("active", "ramping in", "torque_not_delivered")),
    FaultCase("CAN IDs of motors 3 and 4 exchanged", await_refusal, EXCHANGED, None, "started",
        outcomes=("joints_exchanged",)),
)
EFFORTS = (
    FaultCase("compensator frozen, the rest runs on", freeze, ALONE, clear=resume, outcomes=("command_stale",)),
    FaultCase("NaN joint states", unknown_states, PAPER, outcomes=("command_withdrawn",)),
    FaultCase("efforts oscillate at 8 Hz",
        second(lambda now, effort: effort + TREMOR * math.sin(16.0 * math.pi * now)), MONITORED, limit=0.5,
        outcomes=UNEXPLAINED),
    FaultCase("effort of joint 2 with the wrong sign", second(lambda now, effort: -effort), MONITORED, limit=0.3,
        outcomes=UNEXPLAINED),
    FaultCase("compensator stopped for 0.1 s", in_turn(freeze, pause(0.1), resume), ALONE, None, outcomes=("active",),
        speed_limit=STEADY, check=damped_for_a_moment),
    FaultCase("imu stopped for 0.1 s", stop_imu_for_a_moment, PAPER, None, outcomes=("active",),
        speed_limit=STEADY, check=damped_for_a_moment),
    FaultCase("compensator stopped for 0.4 s, then resume", in_turn(freeze, pause(0.4), resume), ALONE,
        outcomes=("command_stale",), speed_limit=STEADY, afterwards=resumed),
)
ARMS = (
    FaultCase("trunk bows past 90 degrees", in_turn(bow(1.9), pause(4.5)), BOWED, None,
        outcomes=("active",), clear=in_turn(bow(0.1), pause(4.0))),
    FaultCase("elbow pushed into the soft wall", happens("wearer", steps=WALL_PUSH), AT_WALL, None, speed_limit=5.0,
        check=not_thrown_back),
)
SUPPLY = (
    FaultCase("enabled, and the supply cut for 4 s while checking", in_turn(CUT, pause(4.0), RELEASE, pause(OBSERVED)),
        SHORT_ENABLE, stage="checking", outcomes=OFF, afterwards=expired),
    FaultCase("supply cut, the arm laid in the lap, then clear and enable", stop_in_the_lap, PAPER,
        unpowered=ALL_JOINTS, steps_from=0.1, check=stays_off),
    supply_case("supply cut for 2 s", CUT, pause(2.0)),
)
OUTER_LOOP = (
    outer_loop_case("outer loop stops", outer_loop(silent=True), "stopped"),
    outer_loop_case("second outer loop for half a second",
        in_turn(outer_loop(others=(0.0, 0.0, 0.0, 0.5)), pause(0.5), outer_loop(others=None)), ""),
    outer_loop_case("outer loop stops, the next one asks for 0 Nm",
        in_turn(outer_loop(silent=True), pause(1.0), outer_loop(silent=False, efforts=(0.0,) * 4)), "",
        check=partial(only_the_assistance_ends, until=math.inf)),
)
LOAD_CHANGES = (
    load_case("Zero-G to One-G, 75 kg", {"mode": "one_g"}, {"mode": "zero_g"}),
    FaultCase("a load of 2 kg is dropped, Zero-G, 75 kg", take_and_drop, LOADED, limit=None, outcomes=("active",),
        speed_limit=DROP_SPEED, afterwards=load_is_withdrawn),
    FaultCase("the arm leaves the cuff, Zero-G, 75 kg", happens("out_of_cuff"), WORN, limit=EMPTY,
        outcomes=("load_missing",), speed_limit=1.5, driven_limit=1.5, energy_limit=1.0),
    # The wearer pulls their arm out on the way back.
    FaultCase("the arm leaves the cuff in a reach, Zero-G, 75 kg",
        in_turn(happens("wearer", steps=REACH_OUT), pause(1.5), happens("limp"), happens("out_of_cuff"), pause(2.0)),
        WORN, limit=None, outcomes=("active",), speed_limit=LOAD_LOST, afterwards=load_is_withdrawn),
)
ACTIVE_WEARER = (
    while_wearer("presses it down from the horizontal", PRESS_DOWN, 0.1, HIGH),
)
FIRMWARE = (
    # Two motors answer each command, and what either reports is taken for what the other applies.
    FaultCase("a second arm with the same IDs on the bus", connect_a_second_arm, PAPER, limit=None, steps_from=math.inf,
        outcomes=("position_jump", "over_speed", "readings_contradict", "torque_not_delivered", "outside_limits",
        "motor_silent")),
    FaultCase("motor 2 mute for 4 s", mute(1), PAPER, outcomes=("motor_silent",), driven_limit=0.6),
    FaultCase("motor 2 reports an encoder error, then clear and enable", ERROR, PAPER,
        afterwards=lambda rig: enabled_in_vain(rig, pause(4.0)), outcomes=("motor_error",)),
)
# Further values of what another row shows: thorough.
FURTHER = (
    # Efforts and tilts that are no number, and efforts that are withdrawn: test_safety.py, test_tilt.py.
    FaultCase("effort NaN", happens("efforts_nan"), COMMANDED),
    FaultCase("NaN tilt", lambda rig: setattr(rig, "imu_frozen", TrunkReading((math.nan,) * 3)), PAPER,
        limit=PROCESS_REACTION, outcomes=("command_withdrawn",)),
    FaultCase("no efforts", happens("efforts_withdrawn"), COMMANDED),
    # The steps are the firmware's own; test_motors.py judges the return.
    *map(stopped, (40, 60, 75)),
    FaultCase("bus silent for 3 s", in_turn(SILENCE, pause(3.0), END_SILENCE), PAPER, unreached=ALL_JOINTS,
        outcomes=("motor_silent",)),
    FaultCase("motor 2 reports an error", ERROR, PAPER, clear=NO_ERROR, outcomes=("motor_error",)),
    FaultCase("motor 2 at 95 degC", happens("motor_hot", joint=1, value=95.0), PAPER, outcomes=("over_temperature",)),
    FaultCase("arm disabled, upright overhead", happens("disable"),
        replace(with_friction(0.01, viscous=[0.0] * 4), pose=(0.0, 2.9, 0.0, 0.0)), outcomes=OFF),
    FaultCase("V3 boards: foreign exit of motor 2, once", exit_frame, ON_V3, steps_from=0.05,
        outcomes=("foreign_command", "torque_not_delivered")),
    outer_loop_case("outer loop sends NaN", outer_loop(efforts=(0.0, math.nan, 0.0, 0.0)), "invalid"),
    FaultCase("who holds control dies", control_dies, PAPER,
        limit=1.0 + LET_DOWN, outcomes=("control_lost",)),
    FaultCase("V3 boards: motor 2 cut off from the bus", CUT_OFF, ON_V3, clear=CONNECT, unreached=(1,),
        outcomes=("motor_silent",)),
    while_wearer("lifts", LIFT, 0.4),
    FaultCase("arm disabled, friction 0.01 Nm", happens("disable"), with_friction(0.01, viscous=[0.0] * 4),
        outcomes=OFF),
    FaultCase("foreign zero commands to motor 2, 500 a second for 2 s", foreign(0.0), PAPER, steps_from=2.1,
        outcomes=("foreign_command",)),
    FaultCase("V3 boards: arm disabled", happens("disable"), ON_V3, outcomes=OFF),
    # Status frames tell what a motor still holds: it drops nothing when it is reached again.
    FaultCase("V3 boards: bus silent until the arm is given up", SILENCE, ON_V3, clear=END_SILENCE,
        unreached=ALL_JOINTS, outcomes=("motor_silent",), driven_limit=0.6),
    FaultCase("V3 boards: motor 2 reports an error", ERROR, ON_V3, clear=NO_ERROR, outcomes=("motor_error",)),
    supply_case("V3 boards: supply cut for 2 s", CUT, pause(2.0), arm=ON_V3),
    supply_case("V3 boards: supply cut for 30 s, cleared meanwhile", CUT, pause(15.0), clear, pause(15.0), arm=ON_V3),
    load_case("V3 boards: Zero-G to One-G, 75 kg", {"mode": "one_g"}, {"mode": "zero_g"}, WORN_V3),
    # 0.4 s after the last foreign frame, while it is let down, one step is 0.32 Nm; 0.22 would be within the bound.
    FaultCase("V3 boards: foreign 6 Nm to motor 2, 500 a second for 2 s", foreign(FOREIGN), ON_V3, steps_from=2.5,
        outcomes=("foreign_command",), energy_limit=2.0),
    FaultCase("arm disabled, friction 0.5 Nm", happens("disable"), with_friction(0.5), outcomes=OFF),
    FaultCase("arm disabled, flexed", happens("disable"), replace(PAPER, pose=(0.0, 0.1, 2.3, 0.1)), outcomes=OFF),
    load_case("support 1 to 0, 75 kg", {"support": 0.0}, {"support": 1.0}),
    load_case("a spring of 14 Nm/rad, Zero-G, 75 kg", SPRING, {"spring.stiffness": [0.0] * 4}),
    load_case("body mass 75 to 100", {"wearer.body_mass": 100.0}, {"wearer.body_mass": 75.0}),
    FaultCase("arm disabled, Zero-G, 75 kg", happens("disable"), WORN, outcomes=OFF),
    supply_case("supply cut for 30 s, cleared meanwhile", CUT, pause(15.0), clear, pause(15.0)),
    while_wearer("holds still", KEEP, 0.5),
    while_wearer("shakes the arm at 2 Hz", SHAKE, 1.0),
    while_wearer("reaches on and on", REACH, 1.0),
    # The thrown arm coasts upwards, and what carries it does the work of its weight on the way: 0.25 to 0.35 J.
    while_wearer("throws the arm", THROW, 0.2, energy_limit=0.5),
    while_wearer("pushes down", PUSH_DOWN, 0.2),
    FaultCase("imu silent while ramping in", happens("imu_silent"), CHECKED, PROCESS_REACTION, "ramping in"),
    FaultCase("arm disabled, bent, on a tilted trunk", happens("disable"), BENT, outcomes=OFF),
    # The largest damping is then 3 Nm s/rad at the joint: no motor is taken for one that is off.
    FaultCase("arm disabled, motors of 0.6 of the torque", happens("disable"), WEAK_MOTORS, outcomes=OFF),
    FaultCase("motor 2 reports an error, Zero-G, 75 kg", ERROR, WORN, clear=NO_ERROR, outcomes=("motor_error",)),
    load_case("max_effort 9 to 0.5 Nm, Zero-G, 75 kg", WEAK, RATED),
    supply_case("V3 boards: supply cut for 3 s, motor 2 back 6 s before the others", CUT, pause(3.0), power(True, 1),
        pause(6.0), arm=ON_V3),
    FaultCase("all motors mute for 4 s", mute(*ALL_JOINTS), PAPER, speed_limit=CARELESS, driven_limit=CARELESS,
        outcomes=("motor_silent",)),
    FaultCase("efforts 3 times too large", change_efforts(lambda now, effort: [3.0 * each for each in effort]),
        MONITORED, limit=0.5, outcomes=UNEXPLAINED),
    FaultCase("compensator's step raises an exception", change_efforts(lambda now, effort: [0.0 / 0.0]), ALONE,
        outcomes=("command_stale",)),
    FaultCase("foreign EXIT to motor 2 while let down", exit_frame, PAPER, stage="letting down", steps_from=0.05),
)
OTHER_ARMS = (
    *rows_of("elbow, AK80-64", ELBOW, lets_go=False),
    # The rotor slows the empty arm so much that its loss is not detected: the brake alone holds it.
    FaultCase("elbow, AK80-64: a load of 2 kg is dropped", take_and_drop, ELBOW, limit=None, outcomes=("active",),
        speed_limit=LOAD_LOST),
    *rows_of("seven Damiao joints", SEVEN, lets_go=True),
    FaultCase("seven Damiao joints: imu silent", happens("imu_silent"), replace(SEVEN, compensator={"use_imu": True}),
        PROCESS_REACTION),
)
# fmt: on
# Of the paper's arm.
PAPERS = (
    *(*MOTORS, *DESCENT, *START, *EFFORTS, *ARMS, *SUPPLY),
    *(*OUTER_LOOP, *LOAD_CHANGES, *ACTIVE_WEARER, *FIRMWARE),
)
ROWS = (*PAPERS, *FURTHER, *OTHER_ARMS)
