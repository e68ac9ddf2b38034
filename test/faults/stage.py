"""Real nodes in processes of their own, and beside them a node that watches and asks, and a listener on the bus."""

import itertools
import json
import os
import threading
import time
from pathlib import Path

import can
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter as RclpyParameter
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from exo_gravity.core.motors import ENTER, EXIT
from exo_gravity.nodes.run import keep_to_this_machine
from exo_gravity.tools.launcher import Launcher

keep_to_this_machine()
CONFIG = Path(__file__).parents[2] / "config"
PORTS = itertools.count(20_000 + os.getpid() % 10_000)
SEATED = {"compensator": {"use_imu": False}}  # starts at once: no IMU to wait for

QUICK = {"sign_check_torque": 0.0, "ramp_time": 0.5, "fade_time": 0.5, "damping": 1.5}
GENTLE = QUICK | {"ramp_time": 1.0, "fade_time": 2.0, "damping": 5.0}
# The longest ages that there may be: tests share a machine that is busy with others.
PATIENT = {
    "can_bridge": {"command_timeout": 0.1, "reply_timeout": 0.1},
    "compensator": {"tilt_timeout": 0.5},
}


class Watcher:
    """A node in this process, spun in a thread: the newest message of each topic, and calls to services."""

    def __init__(self, arm="/right"):
        self.arm = arm
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("watcher", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self._clients = {}
        self.joints, self.efforts, self.wearer, self.diagnostics = [], [], [], {}
        self.node.create_subscription(JointState, f"{arm}/joint_states", self.joints.append, 1000)
        self.node.create_subscription(JointState, f"{arm}/effort_commands", self.efforts.append, 1000)
        self.node.create_subscription(String, f"{arm}/wearer_step", self.wearer.append, 10)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        self._closing = False
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def close(self):
        self._closing = True
        self._thread.join()
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)

    def _spin(self):
        while not self._closing:
            self.executor.spin_once(timeout_sec=0.1)

    def _on_diagnostics(self, message):
        for status in message.status:
            self.diagnostics[f"/{status.name}"] = status

    def said(self, node, text):
        status = self.diagnostics.get(f"{self.arm}/{node}")
        return status is not None and text in status.message

    def value(self, node, key):
        """Return what a node last said of `key` on /diagnostics, None before it said anything."""
        status = self.diagnostics.get(f"{self.arm}/{node}")
        return next((pair.value for pair in status.values if pair.key == key), None) if status else None

    def until(self, condition, timeout=60.0):
        """Wait until `condition()` holds; it is looked at whenever something may have arrived."""
        end = time.monotonic() + timeout
        while not condition():
            told = {name: status.message for name, status in self.diagnostics.items()}
            assert time.monotonic() < end, f"waited {timeout} s in vain; diagnostics: {told}"
            time.sleep(0.01)

    def call(self, kind, name, request, timeout=60.0):
        client = self._clients.get(name) or self._clients.setdefault(name, self.node.create_client(kind, name))
        assert client.wait_for_service(timeout)
        future = client.call_async(request)
        self.until(future.done, timeout)
        return future.result()

    def trigger(self, name):
        return self.call(Trigger, f"{self.arm}/can_bridge/{name}", Trigger.Request())

    def enable(self, on):
        return self.call(SetBool, f"{self.arm}/can_bridge/enable", SetBool.Request(data=on))

    def set(self, node, atomically=False, **values):
        """Set parameters as `ros2 param set` does; `__` in a name stands for a dot."""
        parameters: list[Parameter] = [
            RclpyParameter(name.replace("__", "."), value=value).to_parameter_msg() for name, value in values.items()
        ]
        if atomically:
            kind, name = SetParametersAtomically, f"{self.arm}/{node}/set_parameters_atomically"
            return self.call(kind, name, kind.Request(parameters=parameters)).result
        kind, name = SetParameters, f"{self.arm}/{node}/set_parameters"
        return self.call(kind, name, kind.Request(parameters=parameters)).results[0]

    def position(self):
        return list(self.joints[-1].position)

    def wearer_does(self, action):
        return bool(self.wearer) and json.loads(self.wearer[-1].data)["action"] == action

    def carry(self):
        """Wait until the arm is carried. A machine that stutters lets it down, as it must: then arm it once more."""

        def told(*states):
            return any(self.said("can_bridge", state) for state in states)

        self.until(lambda: told("active", "fault:", "disabled"))
        while not told("active"):
            if told("fault:"):
                assert self.trigger("clear_fault").success
                self.until(lambda: told("disabled"))
            assert self.enable(True).success
            self.until(lambda: told("active", "fault:"))

    def bring_to(self, trial):
        """Let the virtual wearer bring the carried arm where the script file `trial` says, and let go."""
        self.carry()
        self.wearer.clear()
        assert self.set("simulator", trial="").successful
        assert self.set("simulator", trial=str(trial)).successful
        self.until(lambda: self.wearer_does("hold"))


class Stack:
    """The nodes of a parameter file, changed as a test wants it, on a bus of its own.

    Where a test does not ask for more, the start and the way down are made short, `QUICK`, and, unless they are to be
    `punctual`, the nodes patient.
    """

    def __init__(self, folder, base="sim.yaml", without=(), port=None, punctual=False, **changes):
        content = yaml.safe_load((CONFIG / base).read_text())
        port = port or next(PORTS)
        for node in [node for node in content if node.split("/")[-1] in without]:
            del content[node]
        for node, parameters in ((node, entry["ros__parameters"]) for node, entry in content.items()):
            if "can" in parameters:
                parameters["can"]["options"]["port"] = port
            if node.endswith("/can_bridge"):
                parameters.update(QUICK)
            if not punctual:
                parameters.update(PATIENT.get(node.split("/")[-1], {}))
        for node, values in changes.items():
            content["/right/" + node if node != "imu" else "/imu"]["ros__parameters"].update(values)
        self.bus = {"interface": "udp_multicast", "channel": "239.74.163.2", "port": port, "hop_limit": 0}
        self.path = Path(folder) / f"params_{port}_{'_'.join(without)}.yaml"
        self.path.write_text(yaml.safe_dump(content))
        self.log = []
        self.stopping = threading.Event()
        self.dead = None

    def start(self):
        launcher = Launcher(self.path, on_line=lambda node, line: self.log.append(f"{node}: {line}"))
        self.launcher = launcher
        self._thread = threading.Thread(target=lambda: setattr(self, "dead", launcher.run(self.stopping)))
        self._thread.start()
        return self

    @property
    def over(self):
        """Whether every process has ended."""
        return not self._thread.is_alive()

    def stop(self):
        self.stopping.set()
        self._thread.join(60)


class Listener:
    """An independent listener on the bus: every frame in its order, as (s of the system's clock, ID, data)."""

    def __init__(self, bus):
        self.frames = []
        self._bus = can.Bus(**bus)
        self._notifier = can.Notifier(self._bus, [self._take])

    def _take(self, message):
        self.frames.append((message.timestamp, message.arbitration_id, bytes(message.data)))

    def close(self):
        self._notifier.stop()
        self._bus.shutdown()

    def switched_off(self):
        """Whether the last special frame that each motor got is EXIT."""
        return all(self._last_special(can_id) == EXIT for can_id in (1, 2, 3, 4))

    def _last_special(self, can_id):
        return next((data for _, to, data in reversed(self.frames) if to == can_id and data in (ENTER, EXIT)), None)
