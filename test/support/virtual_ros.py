"""Nodes of this process in virtual time, without middleware: a message is with its subscribers at once.

What only DDS can break (discovery, lost messages, processes) is tested with launched nodes.
"""

from __future__ import annotations

import copy
import inspect
import sys
import threading
from collections import defaultdict
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from rclpy.time import Time

from exo_gravity.nodes.ros import hot_path

from ..hardware.virtual_time import VirtualClock

PATIENCE = 20.0  # s of virtual time


class Topic:
    """A publisher: numbers its messages and passes a copy of each on."""

    def __init__(self, ros: VirtualRos, name: str) -> None:
        self._ros, self.name, self._number = ros, name, 0

    def publish(self, message: Any) -> None:
        self._number += 1
        message = copy.deepcopy(message)
        self._ros.messages[self.name].append(message)
        for callback, takes_info in self._ros.subscribers[self.name]:
            callback(message, *[{"publication_sequence_number": self._number}][:takes_info])


class VirtualThread:
    """A thread that runs only while virtual time passes, from one of its sleeps to the next."""

    def __init__(self, clock: VirtualClock, target: Callable[[], object]) -> None:
        self.ident: int | None = None
        self._clock, self._target = clock, target
        self._go, self._rests = threading.Semaphore(0), threading.Semaphore(0)

    def start(self) -> None:
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        self.ident = self._thread.ident
        self._clock.later(0.0, self._step)

    def _run(self) -> None:
        self._go.acquire()
        self._target()
        self.has_ended = True
        self._rests.release()

    has_ended = False

    def _step(self) -> None:
        self._go.release()
        self._rests.acquire()

    def sleep(self, duration: float) -> None:
        self._clock.later(duration, self._step)
        self._rests.release()
        self._go.acquire()

    def join(self) -> None:
        self._clock.run(PATIENCE, lambda: self.has_ended)
        assert self.has_ended


class VirtualRos:
    """The clock, the topics and the services of all nodes. messages: copies of what was published so far, by topic."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock = VirtualClock()
        self.messages: dict[str, list[Any]] = defaultdict(list)
        self.subscribers: dict[str, list[tuple[Callable[..., object], int]]] = defaultdict(list)
        self.services: dict[str, tuple[Callable[..., Any], type]] = {}
        self._threads: list[VirtualThread] = []
        replaced: dict[str, Callable[..., Any]] = {
            "create_publisher": lambda node, _, topic, *__, **___: Topic(self, node.resolve_topic_name(topic)),
            "create_subscription": lambda node, _, topic, callback, *__, **___: self.subscribe(node, topic, callback),
            "create_service": lambda node, *args, **_: self._serve(node, *args),
            "create_timer": lambda _, period, callback: self.clock.every(period, callback),
            "create_guard_condition": lambda _, callback: SimpleNamespace(
                trigger=lambda: self.clock.later(0.0, callback)
            ),
            "get_clock": lambda _: SimpleNamespace(now=self.now),
        }
        for name, function in replaced.items():
            monkeypatch.setattr(Node, name, function)
        of_path: dict[str, Callable[..., object]] = {
            "__init__": lambda path, *args, **_: self._hot_path(path, *args),
            "start": lambda _: None,
            "stop": lambda _: None,
        }
        for name, function in of_path.items():
            monkeypatch.setattr(hot_path.HotPath, name, function)
        time = SimpleNamespace(monotonic=self.clock.monotonic, sleep=self._sleep)
        threads = SimpleNamespace(Lock=threading.Lock, Thread=self._thread)
        for name, module in list(sys.modules.items()):
            if name.startswith("exo_gravity.nodes."):
                for attribute, value in (("time", time), ("threading", threads)):
                    if inspect.ismodule(getattr(module, attribute, None)):
                        monkeypatch.setattr(module, attribute, value)

    def now(self) -> Time:
        return Time(nanoseconds=round(self.clock.monotonic() * 1e9))

    def subscribe(self, node: Node, topic: str, callback: Callable[..., object]) -> None:
        takes_info = len(inspect.signature(callback).parameters) - 1
        self.subscribers[node.resolve_topic_name(topic)].append((callback, takes_info))

    def _hot_path(self, path: Any, node: Node, _: type, topic: str, callback: Any, *__: Any) -> None:
        path.failure = None
        self.subscribe(node, topic, callback)

    def _serve(self, node: Node, kind: type, name: str, callback: Callable[..., Any]) -> None:
        self.services[node.resolve_service_name(name)] = callback, kind

    def call(self, name: str, request: Any = None) -> Any:
        """Return the response of the service `name`."""
        callback, kind = self.services[name]
        response = callback(request or kind.Request(), kind.Response())  # type: ignore[attr-defined]
        self.clock.run(0.0)
        return response

    def _thread(self, target: Callable[[], object], **_: Any) -> VirtualThread:
        self._threads.append(VirtualThread(self.clock, target))
        return self._threads[-1]

    def _sleep(self, duration: float) -> None:
        """Let virtual time pass; of a virtual thread, this thread alone waits."""
        current = threading.current_thread()
        thread = next((thread for thread in self._threads if thread.ident == current.ident), None)
        if thread or current is threading.main_thread():
            (thread or self.clock).sleep(duration)

    def status(self, name: str) -> DiagnosticStatus:
        """Return the newest status of the node `name`, an empty one before the first."""
        reports = (status for array in reversed(self.messages["/diagnostics"]) for status in array.status)
        return next((status for status in reports if status.name == name), DiagnosticStatus())

    def wait_until(self, condition: Callable[[], object]) -> None:
        """Let virtual time pass until `condition()` holds."""
        if not condition():
            self.clock.run(PATIENCE, condition)
            assert condition(), self.messages["/diagnostics"][-1:]


def start_ros(namespace: str, **parameters: object) -> None:
    """Initialise rclpy for nodes in `namespace` with these parameters (`__` for a dot)."""
    args = ["--ros-args", "-r", f"__ns:={namespace}"]
    for name, value in parameters.items():
        args += ["-p", f"{name.replace('__', '.')}:={str(value).lower() if isinstance(value, bool) else value}"]
    rclpy.init(args=args)
