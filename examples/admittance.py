# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A cascade controller to start from: the arm moves as its wearer's torque asks (admittance). For any number of joints.

    wearer_efforts -> admittance -> speed -> position loop -> speed -> velocity loop -> assist_efforts

`python examples/admittance.py my.yaml /right` runs it as a node at 100 Hz, alongside the nodes of a
parameter file. The compensator adds its efforts once `assist.max_effort` is not 0, in Zero-G at a support of 1: only
then is the wearer's torque what they mean to do, and not the weight that is left to them.

`python examples/admittance.py` plays it on a simulated wearer, without nodes, and plots their torque without and with
it; with a file's name (.png, .pdf, .svg) the plot is written there instead.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import copysign, sqrt

import matplotlib.pyplot as plt
import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import JointState

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.interface import Links
from exo_gravity.core.arm.rotation import ZERO
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import ModelError, Settings
from exo_gravity.core.compensation.terms.assist import Assist
from exo_gravity.core.compensation.terms.catalogue import SPRING, Friction, clamp
from exo_gravity.core.compensation.terms.terms import TermSettings
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.numbers import COVER, for_joints
from exo_gravity.core.safety.command import State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.inputs.arms import read_arm
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.lab.observer import MomentumObserver
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor, VirtualWearer
from exo_gravity.sim.controllers import DirectController
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.virtual_arm import VirtualArm

PERIOD = 0.01  # s


@dataclass(frozen=True)
class Tuning:
    """How the arm answers its wearer."""

    assistance: float = 1.0  #: Nm of the motors for each Nm of the wearer: 1 halves the inertia that they feel
    coasting: float = 1.0  #: s, time constant with which an arm that nobody pushes slows down
    stiffness: float = 3.0  #: 1/s, of the position loop: speed for each rad that the arm is behind
    reach: float = 0.1  #: rad that the wanted angle may be ahead of the arm
    fastest: float = 1.5  #: rad/s that is wanted at most
    late: float = 0.03  #: s from a joint's reading to the torque for it: this loop's period, and twice the arm's


TUNING = Tuning()


class Admittance:
    """The cascade of every joint, as stiff as is stable `late` s late. It bounds itself as the terms do: docs/terms.md.

    robot: the inertia of the arm alone, which decides what is stable. worn: with the wearer's arm, which they move.
    """

    def __init__(self, robot: Links, worn: Links, tuning: Tuning = TUNING) -> None:
        count = len(robot.least)
        self.viscosity = [inertia / (2.0 * tuning.late) for inertia in robot.least]  #: Nm s/rad, of the velocity loop
        self.most = for_joints(SPRING.effort, count)  #: Nm, which a hand overcomes
        self._worn, self._tuning = worn, tuning
        self._speed = [0.0] * count  # rad/s, that the wearer asks for
        self._angle: list[float] = []  # rad, that is wanted

    def step(
        self,
        position: Sequence[float],
        velocity: Sequence[float],
        wearer: Sequence[float],
        deviation: Sequence[float],
    ) -> list[float]:
        """Return the efforts (n,) in Nm, PERIOD after the last ones.

        position, velocity: (n,) rad and rad/s. wearer, deviation: their torque and its standard deviation, (n,) Nm.
        """
        tuning, efforts = self._tuning, []
        self._angle = self._angle or list(position)
        inertias = self._worn.matrix(position).diagonal().tolist()
        for n, (q, v, torque, inertia) in enumerate(zip(position, velocity, wearer, inertias, strict=True)):
            # What could be an error of the model is not followed: an arm that is left alone stays.
            sure = copysign(max(0.0, abs(torque) - COVER * deviation[n]), torque)
            # Admittance: the speed of an arm of less inertia, with friction. `given` is what the motors add for that.
            gain, friction = 1.0 + tuning.assistance, inertia / tuning.coasting * self._speed[n]
            given = tuning.assistance * sure - friction
            speed = self._speed[n] + PERIOD * (gain * sure - friction) / inertia
            self._speed[n] = clamp(speed, tuning.fastest)
            # Position loop: the angle that this speed leads to, not far from the arm's.
            ahead = clamp(self._angle[n] + PERIOD * self._speed[n] - q, tuning.reach)
            self._angle[n] = q + ahead
            wanted = clamp(self._speed[n] + tuning.stiffness * ahead, tuning.fastest)
            # Velocity loop.
            efforts.append(clamp(given + self.viscosity[n] * (wanted - v), self.most[n]))
        return efforts


def cascade_of(settings: Settings) -> Admittance:
    """Return the cascade for an arm and the wearer that its compensator knows."""
    return Admittance(settings.robot.links, settings.robot.worn_links(settings.wearer_mass, settings.wearer_cog))


class AdmittanceNode(Node):
    """The cascade between the nodes `wearer` and `compensator` of one arm.

    names: of its joints (n,). settings: of its compensator.
    """

    silence = Duration(seconds=0.1)  # without joint states or the wearer's torque

    def __init__(self, namespace: str, names: Sequence[str], settings: Settings) -> None:
        super().__init__("admittance", namespace=namespace)
        self.names, self.settings = list(names), settings
        self.cascade = cascade_of(settings)
        self.heard = {}
        self.publisher = self.create_publisher(JointState, "assist_efforts", 1)
        for topic in ("joint_states", "wearer_efforts", "wearer_efforts_std"):
            self.create_subscription(JointState, topic, lambda message, topic=topic: self.hear(topic, message), 1)
        self.create_timer(PERIOD, self.publish)
        self.create_timer(5.0, self.report)

    def hear(self, topic, message):
        """Keep the newest message of a topic."""
        self.heard[topic] = self.get_clock().now(), message

    def newest(self, topic, field):
        """Return a field (n,) of the newest message, in the order of the names; None if it is old or incomplete."""
        heard, message = self.heard.get(topic, (None, None))
        if heard is None or self.get_clock().now() - heard > self.silence:
            return None
        values = dict(zip(message.name, getattr(message, field), strict=False))
        return [values[name] for name in self.names] if values.keys() >= set(self.names) else None

    def publish(self):
        """Send efforts while everything that they need is new."""
        inputs = [self.newest("joint_states", field) for field in ("position", "velocity")]
        inputs += [self.newest(topic, "effort") for topic in ("wearer_efforts", "wearer_efforts_std")]
        if None in inputs:  # no message: the compensator fades the assistance; later the cascade begins anew
            self.cascade = cascade_of(self.settings)
            return
        message = JointState(name=self.names, effort=self.cascade.step(*inputs))
        message.header.stamp = self.get_clock().now().to_msg()
        self.publisher.publish(message)

    def report(self):
        """Say what the cascade waits for."""
        if self.newest("wearer_efforts", "effort") is None:
            self.get_logger().info("waiting for wearer_efforts: does the node wearer of this arm run?")
        elif not self.publisher.get_subscription_count():
            self.get_logger().info("no compensator subscribes to assist_efforts: set its assist.max_effort")


# The simulated trial: a wearer of 60 kg reaches to and fro in Zero-G at a support of 1.
JOINTS = ("rotation", "abduction", "flexion", "elbow")
PEAK = (9.0, 18.0, 9.0, 9.0)  # Nm
NEAR, FAR = [0.0, 0.4, 0.3, 0.5], [0.3, 0.7, 0.7, 0.9]  # rad
COULOMB, VISCOUS = (0.2, 0.4, 0.2, 0.2), (0.02, 0.05, 0.02, 0.02)  # as identified


class LoggedWearer(VirtualWearer):
    """A virtual wearer whose angles and torque are kept."""

    def __init__(self, script):
        super().__init__(script)
        self.log = []

    def torque(self, elapsed, theta, velocity):
        """Return the wearer's torque (4,) in Nm."""
        torque = super().torque(elapsed, theta, velocity)
        self.log.append((elapsed, tuple(theta), torque))
        return torque


def reach(is_assisted):
    """Return s, angles (4,) rad and torques (4,) Nm of a wearer who reaches, at every step of the device."""
    robot = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
    mass, cog = Wearer(body_mass=60.0).on_links(robot.length)
    names = ("AK60-6", "AK80-9", "AK60-6", "AK60-6")
    motors = [JointMotor(MOTORS[name], can_id) for can_id, name in enumerate(names, 1)]
    arm_config = ArmConfig(wearer_mass=mass, wearer_cog=cog, coulomb_friction=COULOMB, viscous_friction=VISCOUS)
    device = SimulatedDevice(SimulatedArm(arm_config), [SimulatedMotor(motor) for motor in motors])
    settings = Settings("right", robot, mode="zero_g", support=1.0, wearer_mass=mass, wearer_cog=cog, use_imu=False)
    known = ModelError((0.1, 0.1, 0.1, 0.05), (0.02,) * 4, 0.03, 0.005)  # as after a calibration
    terms = TermSettings(friction=Friction(coulomb=COULOMB, viscous=VISCOUS), assist=Assist(SPRING.effort))
    settings = replace(settings, max_effort=PEAK, model_error=known, terms=terms)
    compensator, observer = Compensator(settings, JOINTS), MomentumObserver(settings)
    limits = Limits(JOINTS, max_effort=PEAK, sign_check_torque=0.0)
    arm = VirtualArm(device, DirectController(compensator, limits), motors, limits, 250.0)
    cascade = cascade_of(settings)

    def answer():
        position, velocity, effort, *_ = zip(*arm.loop.samples, strict=True)
        estimate = observer.update(arm.now, (position, velocity, effort), Tilt.of("right"), ZERO)
        efforts = cascade.step(position, velocity, estimate.torque, estimate.deviation)
        compensator.terms.assist.receive(arm.now, JOINTS, efforts, arm.now)

    arm.enable()
    arm.run_until(lambda: arm.safety.state is State.ACTIVE)
    if is_assisted:
        arm.clock.every(PERIOD, answer)
    steps = [step for pose in (NEAR, FAR) * 4 for step in ({"move": pose, "over": 1.2}, {"hold": 0.6})]
    wearer = LoggedWearer(TrialScript.parse({"name": "reach", "steps": steps}))
    device.start(wearer, delay=1.0)
    arm.run(1.0 + wearer.script.duration)
    return [list(column) for column in zip(*wearer.log, strict=True)]


def effort_of(torques):
    """Return the root mean square of the torque (n, 4) over all joints, in Nm."""
    return sqrt(sum(tau * tau for torque in torques for tau in torque) / len(torques))


def simulate(plot=""):
    """Compare the wearer's torque without and with the cascade."""
    trials = {"without": reach(False), "with the cascade": reach(True)}
    alone, assisted = (effort_of(torques) for _, _, torques in trials.values())
    print(f"The wearer gives {alone:.2f} Nm (RMS) alone and {assisted:.2f} Nm with the cascade.")
    figure, axes = plt.subplots(len(JOINTS), sharex=True, layout="constrained", figsize=(7.0, 7.0))
    for n, (axis, joint) in enumerate(zip(axes, JOINTS, strict=True)):
        for label, (times, _, torques) in trials.items():
            axis.plot(times, [torque[n] for torque in torques], label=label, linewidth=1.0)
        axis.set_ylabel(f"{joint} (Nm)")
    axes[0].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    axes[-1].set_xlabel("Time (s)")
    figure.suptitle("Torque of a simulated wearer who reaches to and fro", x=0.02, ha="left")
    plt.savefig(plot) if plot else plt.show()


def main(words):
    """Run the node for `FILE NAMESPACE`, else the simulation."""
    if not (words and words[0].endswith((".yaml", ".yml"))):
        simulate(*words)
        return
    path, namespace = words
    arm = read_arm(load(path), namespace)
    rclpy.init()
    rclpy.spin(AdmittanceNode(namespace, arm.limits.joint_names, arm.settings))


if __name__ == "__main__":
    main(sys.argv[1:])
