# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What each kind of event does to a `Stage`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from .stage import Stage

RAMP_STEPS = 20  # in which an IMU's error grows, or a motor warms
WARMING = 4.0  # s
Act = Callable[..., None]


def during(stage: Stage, duration: float, begin: Callable[[], None], end: Callable[[], None]) -> None:
    """Call `begin` now and `end` in `duration` s."""
    begin()
    stage.clock.later(duration, end)


def setting(stage: Stage, owner: object, name: str, value: object, normal: object, duration: float) -> None:
    """Give an attribute a value for `duration` s."""
    stage.arm.catch_up()
    during(stage, duration, lambda: setattr(owner, name, value), lambda: setattr(owner, name, normal))


def gradually(stage: Stage, duration: float, step: Callable[[float], None]) -> None:
    """Call step(share) with a share that grows to 1 within `duration` s."""
    for number in range(1, RAMP_STEPS + 1):
        share = number / RAMP_STEPS
        stage.clock.later(share * duration, partial(step, share))


def toggle(stage: Stage, duration: float) -> None:
    """Disable the arm, and enable it `duration` s later."""
    stage.between_cycles(stage.safety.disable)
    stage.clock.later(duration, lambda: stage.between_cycles(stage.safety.enable))


def rearm(stage: Stage, duration: float) -> None:
    """Clear the fault, and enable the arm `duration` s later."""
    stage.between_cycles(stage.safety.clear)
    stage.clock.later(duration, lambda: stage.between_cycles(stage.safety.enable))


def mode(stage: Stage) -> None:
    """Change from zero-G to one-G, or back."""
    stage.change(mode="one_g" if stage.settings.mode == "zero_g" else "zero_g")


def max_effort(stage: Stage, share: float) -> None:
    """Lower every effort limit to a share of what it is."""
    stage.change(max_effort=tuple(share * most for most in stage.settings.max_effort))


def body_mass(stage: Stage, mass: float) -> None:
    """Set the mass of the wearer's body, in kg, as the operator would."""
    load = stage.played.load_of(mass)
    stage.change(wearer_mass=load.mass.tolist(), wearer_cog=load.cog.tolist())


def supply_cut(stage: Stage, motors: list[int], duration: float) -> None:
    """Cut the supply: after it the encoders, on the rotors, know the angle only within a turn of the rotor."""

    def power(is_on: bool) -> None:
        stage.arm.catch_up()
        errors = list(stage.device.encoder_error)
        for joint in motors:
            motor = stage.motors[joint]
            motor.unplugged = not is_on
            turn = 2.0 * math.pi / motor.joint.spec.gear_ratio
            errors[joint] = -turn * round(stage.device.arm.positions[joint] / turn)
        stage.device.encoder_error = errors

    power(False)
    stage.clock.later(duration, partial(power, True))


def lost(which: str) -> Act:
    """Return the act that loses commands or replies of some motors for a time."""

    def inject(stage: Stage, motors: list[int], duration: float) -> None:
        joints: set[int] = getattr(stage.wire, which)
        during(stage, duration, lambda: joints.update(motors), lambda: joints.difference_update(motors))

    return inject


def encoder_slip(stage: Stage, joint: int, error: float) -> None:
    """Add `error` rad to what the encoder of a joint reads."""
    stage.arm.catch_up()
    errors = list(stage.device.encoder_error)
    errors[joint] += error
    stage.device.encoder_error = errors


def wrong_speed(stage: Stage, joint: int, factor: float, duration: float) -> None:
    """Multiply the speed that a motor reports for `duration` s."""
    setting(stage, stage.motors[joint], "speed_factor", factor, 1.0, duration)


def torque_reversed(stage: Stage, joint: int) -> None:
    """Let a motor turn against its commands."""
    stage.motors[joint].reversed = True


def motor_error(stage: Stage, joint: int, code: int) -> None:
    """Let a motor report an error code from now on."""
    stage.motors[joint].error = code


def motor_warms(stage: Stage, joint: int, most: float) -> None:
    """Warm a motor from 60 to `most` degC."""
    motor = stage.motors[joint]
    gradually(stage, WARMING, lambda share: setattr(motor, "temperature", 60.0 + share * (most - 60.0)))


def stall(stage: Stage, duration: float) -> None:
    """Stop the control loop for `duration` s."""
    stage.controller.stall = duration


def efforts(fault: str) -> Act:
    """Return the act that spoils the compensator's efforts for a time."""
    return lambda stage, duration: setting(stage, stage.controller, "fault", fault, "", duration)


def efforts_late(stage: Stage, duration: float) -> None:
    """Delay the compensator's efforts for `duration` s."""
    stage.controller.delay = min(0.3, duration)
    setting(stage, stage.controller, "fault", "late", "", duration)


def reach(stage: Stage, pose: list[float], duration: float) -> None:
    """Let the wearer move their arm to a pose (n,) rad within `duration` s."""
    stage.act({"move": list(pose), "over": duration})


def resist(stage: Stage, duration: float) -> None:
    """Let the wearer hold their arm where it is for `duration` s."""
    stage.arm.catch_up()
    stage.act({"move": stage.device.arm.positions, "over": duration})


def spasm(stage: Stage, size: float) -> None:
    """Shake the arm: eight pushes of 0.15 s, to and fro."""
    torque = [size * most for most in stage.played.spasm]
    stage.act(*({"push": [sign * each for each in torque], "over": 0.15} for sign in (1.0, -1.0) * 4))


def push(stage: Stage, torque: list[float], duration: float) -> None:
    """Push the joints with torques (n,) N m for `duration` s."""
    stage.act({"push": list(torque), "over": duration})


def payload_taken(stage: Stage, mass: float, told: float) -> None:
    """Let the wearer pick up `mass` kg; the operator sets the payload to `told` times that mass."""
    stage.arm.catch_up()
    stage.device.arm.carry(mass)
    stage.change(payload_mass=told * mass)


def payload_dropped(stage: Stage) -> None:
    """Let the wearer drop what they carry."""
    stage.arm.catch_up()
    stage.device.arm.carry(0.0)


def payload_flicked(stage: Stage) -> None:
    """Let the wearer throw upwards what they carry."""
    stage.act({"push": list(stage.played.flick), "over": 0.2})
    stage.clock.later(0.15, lambda: payload_dropped(stage))


def out_of_cuff(stage: Stage) -> None:
    """Let the wearer pull their arm out of the exoskeleton."""
    stage.arm.catch_up()
    arm = stage.device.arm
    arm.config = replace(arm.config, wearer_mass=(0.0,) * len(arm.config.wearer_mass))
    arm.carry(0.0)


def imu_wrong(stage: Stage, pitch: float, roll: float, duration: float) -> None:
    """Let the IMU's error grow to `pitch` and `roll` rad within `duration` s."""

    def step(share: float) -> None:
        stage.imu_error = [share * pitch, share * roll]

    gradually(stage, duration, step)


def imu_frozen(stage: Stage, duration: float) -> None:
    """Repeat the IMU's newest reading for `duration` s."""
    setting(stage, stage, "imu_frozen", stage.newest_reading, None, duration)


def imu_silent(stage: Stage, duration: float) -> None:
    """Silence the IMU for `duration` s."""
    setting(stage, stage, "imu_silent", True, False, duration)


ACTS: dict[str, Act] = {
    "disable": lambda stage: stage.between_cycles(stage.safety.disable),
    "enable": lambda stage: stage.between_cycles(stage.safety.enable),
    "clear": lambda stage: stage.between_cycles(stage.safety.clear),
    "resume": lambda stage: stage.between_cycles(stage.safety.resume),
    "toggle": toggle,
    "rearm": rearm,
    "mode": mode,
    "support": lambda stage, support: stage.change(support=support),
    "max_effort": max_effort,
    "body_mass": body_mass,
    "supply_cut": supply_cut,
    "commands_lost": lost("commands_lost"),
    "replies_lost": lost("replies_lost"),
    "bus_silent": lambda stage, duration: setting(stage, stage.device, "bus_silent", True, False, duration),
    "encoder_slip": encoder_slip,
    "wrong_speed": wrong_speed,
    "torque_reversed": torque_reversed,
    "motor_error": motor_error,
    "motor_warms": motor_warms,
    "stall": stall,
    "efforts_late": efforts_late,
    "efforts_withdrawn": efforts("withdrawn"),
    "efforts_nan": efforts("nan"),
    "reach": reach,
    "limp": lambda stage: stage.act(),
    "lap": lambda stage, duration: stage.act({"move": list(stage.played.lap), "over": duration}),
    "resist": resist,
    "spasm": spasm,
    "push": push,
    "payload_taken": payload_taken,
    "payload_dropped": payload_dropped,
    "payload_flicked": payload_flicked,
    "out_of_cuff": out_of_cuff,
    "imu_wrong": imu_wrong,
    "imu_creeps": imu_wrong,
    "imu_frozen": imu_frozen,
    "imu_silent": imu_silent,
    "trunk_falls": lambda stage, bow, duration: stage.act({"bow": bow, "over": duration}, {"hold": 30.0}),
    "lean": lambda stage, lean, duration: stage.act({"lean": lean, "over": duration}, {"hold": 30.0}),
}


def do(stage: Stage, name: str, values: dict[str, Any]) -> None:
    """Let an event of this kind happen now."""
    ACTS[name](stage, **values)
