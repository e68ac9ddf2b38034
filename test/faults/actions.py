# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""How faults are caused: signals to processes, faults of the simulated device, foreign messages and frames."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import can
import yaml
from geometry_msgs.msg import Quaternion, Vector3, Vector3Stamped
from sensor_msgs.msg import Imu, JointState

from exo_gravity.core.motors.frames import Frame
from exo_gravity.core.motors.joint_motor import is_fd
from exo_gravity.hardware.can.can_port import message_of
from exo_gravity.lab.inputs.parameter_file import can_options, load

from ..support.launched_nodes import executable
from .fault_case import Action
from .load import start_frames, start_spin
from .rig import Rig

Steps = Sequence[Mapping[str, Any]]

START_LIMIT = 15.0  # s for a process that must refuse to run
FRAME_RATE = 3000  # random frames per second; with our own 2,000, as many as five Python processes on two cores receive


def pause(seconds: float) -> Action:
    return lambda rig: time.sleep(seconds)


def send_signal(node: str, number: int) -> Action:
    return lambda rig: os.kill(rig.pid(node), number)


def signal_watchdog(number: int) -> Action:
    return lambda rig: os.kill(rig.watchdog, number)


def signal_bridge_and_watchdog(number: int) -> Action:
    def inject(rig: Rig) -> None:
        for pid in (rig.watchdog, rig.pid("can_bridge")):
            os.kill(pid, number)

    return inject


def kill_bridge_with_frozen_watchdog(seconds: float) -> Action:
    """Freeze the watchdog for `seconds` s, and kill the bridge meanwhile."""

    def inject(rig: Rig) -> None:
        watchdog = rig.watchdog
        os.kill(watchdog, signal.SIGSTOP)
        os.kill(rig.pid("can_bridge"), signal.SIGKILL)
        time.sleep(seconds)
        os.kill(watchdog, signal.SIGCONT)

    return inject


def simulator(**values: Any) -> Action:
    """Set parameters of the simulator."""

    def inject(rig: Rig) -> None:
        for name, value in values.items():
            result = rig.probe.set_parameters("simulator", **{name: value})
            assert result.successful, result.reason

    return inject


def compensator(values: Mapping[str, Any]) -> Action:
    """Set parameters of the compensator together."""

    def inject(rig: Rig) -> None:
        named = {name.replace(".", "__"): value for name, value in values.items()}
        result = rig.probe.set_parameters("compensator", atomically=True, **named)
        assert result.successful, result.reason

    return inject


def wearer(rig: Rig, steps: Steps) -> None:
    """Let the wearer do these steps of a trial script from now on."""
    script = rig.write_script(f"wearer_{time.monotonic_ns()}", steps)
    result = rig.probe.set_parameters("simulator", trial=str(script))
    assert result.successful, result.reason


def publish(message_type: type, topic: str, make_message: Callable[[Rig], object]) -> Action:
    """Publish the message for half a second, from a publisher that does not belong to the arm."""

    def inject(rig: Rig) -> float:
        publisher = rig.probe.node.create_publisher(message_type, topic, 1)
        rig.probe.wait_until(lambda: publisher.get_subscription_count() > 0)
        start = time.time()
        for _ in range(50):  # a single message may be overwritten by the next regular one before it is read
            publisher.publish(make_message(rig))
            time.sleep(0.01)
        rig.probe.node.destroy_publisher(publisher)
        return start

    return inject


def states_at(position: list[float]) -> Callable[[Rig], JointState]:
    """Joint states with this `position` in rad, otherwise like the arm's newest."""

    def make_message(rig: Rig) -> JointState:
        newest = rig.probe.joint_states[-1]
        return JointState(header=newest.header, name=newest.name, position=position)

    return make_message


def stamped(rig: Rig, message: Any) -> Any:
    """Return the message with the present time as its stamp."""
    message.header.stamp = rig.probe.node.get_clock().now().to_msg()
    return message


def tilt(pitch: float) -> Callable[[Rig], Vector3Stamped]:
    return lambda rig: stamped(rig, Vector3Stamped(vector=Vector3(y=pitch)))


def trunk_imu(x: float, w: float) -> Callable[[Rig], Imu]:
    """Return what makes a message of /imu/data with the orientation (x, 0, 0, w)."""
    return lambda rig: stamped(rig, Imu(orientation=Quaternion(x=x, w=w)))


def overload_processors(rig: Rig) -> None:
    """Start four busy processes for each of two processors, for 3 s."""
    for process in [start_spin(3.0) for _ in range(8)]:
        process.wait()


def start_second_bridge(namespace: str) -> Action:
    """Start another bridge on the same bus; see `has_refused`."""

    def inject(rig: Rig) -> None:
        rig.second_bridge = run_bridge(rig, namespace)

    return inject


def has_refused(rig: Rig) -> None:
    """Check that the second bridge has refused to run, and has named the owner of the bus."""
    code, log = rig.second_bridge
    assert code not in (0, None), f"a second can_bridge ran on the same bus: {log[-1:]}"
    assert any("is held by" in line for line in log), f"a second can_bridge ended without naming the owner: {log[-1:]}"


def second_bridge(
    rig: Rig, namespace: str, environment: Mapping[str, str] | None = None, **streams: Any
) -> subprocess.Popen[str]:
    """Start a second bridge on the rig's bus. environment: changes of its variables."""
    content = yaml.safe_load(rig.nodes[0].path.read_text())["/right/can_bridge"]
    path = rig.folder / f"second_bridge_{time.monotonic_ns()}.yaml"
    path.write_text(yaml.safe_dump({f"{namespace}/can_bridge": content}))
    command = [executable("can_bridge"), "--ros-args", "-r", f"__ns:={namespace}", "--params-file", str(path)]
    return subprocess.Popen(
        command, env={**os.environ, **(environment or {})}, text=True, start_new_session=True, **streams
    )


def run_bridge(rig: Rig, namespace: str, **options: Any) -> tuple[int | None, list[str]]:
    """Run a `second_bridge`; return its exit code, None if it had to be ended, and its log."""
    process = second_bridge(rig, namespace, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **options)
    try:
        output, code = process.communicate(timeout=START_LIMIT)[0], process.returncode
    except subprocess.TimeoutExpired:
        process.terminate()
        try:
            output, code = process.communicate(timeout=START_LIMIT)[0], None
        except subprocess.TimeoutExpired:
            process.kill()
            output, code = process.communicate()[0], None
    return code, output.splitlines()


def random_frames(count: int, ids: Iterable[int]) -> Action:
    """Send `count` frames of random content under random `ids`."""

    def inject(rig: Rig) -> None:
        sender = start_frames(rig.nodes[0].bus, count, FRAME_RATE, ids)
        rig.probe.wait_until(lambda: sender.poll() is not None, 2 * count / FRAME_RATE + 30.0)
        assert sender.returncode == 0

    return inject


def foreign_frames(frame: bytes | Callable[[Rig], Frame], rate: float = 1.0, seconds: float = 0.0) -> Action:
    """Send to the motor that is struck as another host would: once, or `rate` a second for `seconds` s.

    frame: the bytes of a command, or what returns the whole frame.
    """

    def inject(rig: Rig) -> float:
        motor = rig.motors[rig.struck]
        whole = (motor.command_id, frame) if isinstance(frame, bytes) else frame(rig)
        message = message_of(whole, is_fd(can_options(load(rig.nodes[0].path)["/right/can_bridge"])))
        with can.Bus(**rig.nodes[0].bus) as bus:
            wall, start = time.time(), time.monotonic()
            for number in range(1 + int(rate * seconds)):
                time.sleep(max(0.0, start + number / rate - time.monotonic()))
                bus.send(message)
        return wall

    return inject


SILENCE, END_SILENCE = simulator(fault__bus_silent=True), simulator(fault__bus_silent=False)
