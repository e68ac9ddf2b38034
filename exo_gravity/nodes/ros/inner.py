# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The inner parts of rclpy that the nodes use, in one file: they may change between distributions.

`WaitSet` and `take_message` are needed. The others have a fallback in rclpy's public interface, which says less:

    part                                    without it
    `_take_service`                         a request is as old as the executor stood still; an executor that awaits
                                            an answer does nothing else meanwhile
    `set_parameters_atomically`, replaced   a read-only parameter that is set to its own value is refused, by name;
                                            one that is not declared is refused without the names of the others

rclpy's handlers of the standard services raise on some wrong requests, and an exception in an executor ends the node.
So `guard` lets them answer a failure. An exception of this package still ends the node, which lets the arm down.
"""

import inspect
import time
from collections.abc import Callable, Coroutine, Generator
from functools import partial
from typing import Any, NamedTuple

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetLoggerLevelsResult, SetParametersResult
from rcl_interfaces.srv import SetLoggerLevels, SetParameters, SetParametersAtomically
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.service import Service

STOOD_STILL = 1.0  # s between two looks at what is due, after which an executor has stood still
QUEUED_TIME = 0.5  # s after that in which requests may have been queued meanwhile
LONGEST_LOOK = 0.1  # s for which an executor waits
PACKAGE = __name__.partition(".")[0]


class OutsideExecutor(ReentrantCallbackGroup):
    """Keeps its subscriptions out of the executor's wait set."""

    def can_execute(self, entity: Any) -> bool:
        """Return False: the executor handles none of them."""
        return False


class Inbox:
    """Messages that wait in the middleware, with a wait set for this topic alone. raw: whether bytes suffice."""

    def __init__(self, node: Node, msgtype: type, topic: str, qos: QoSProfile, raw: bool) -> None:
        self._wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)
        self._subscription = node.create_subscription(
            msgtype, topic, lambda message: None, qos, callback_group=OutsideExecutor(), raw=raw
        )
        self._take = self._subscription.handle.take_message

    def wait(self, timeout: float) -> None:
        """Wait up to `timeout` s for a message."""
        handle = self._subscription.handle
        with handle:
            self._wait_set.clear_entities()
            self._wait_set.add_subscription(handle)
            self._wait_set.wait(int(timeout * 1e9))

    def take(self) -> tuple[Any, dict[str, Any]] | None:
        """Return the oldest message and rclpy's information on it, None if there is none."""
        taken: tuple[Any, dict[str, Any]] | None = self._take(self._subscription.msg_type, self._subscription.raw)
        return taken


class Until:
    """Awaits `is_done()`, for at most `timeout` s. An executor of another kind than `NodeExecutor` waits busily."""

    def __init__(self, is_done: Callable[[], object], timeout: float) -> None:
        self._is_done, self._end = is_done, time.monotonic() + timeout

    def __await__(self) -> Generator[None, None, None]:
        """Yield until it is done."""
        while not self._is_done() and time.monotonic() < self._end:
            yield


class _Waiting(NamedTuple):
    """A service's callback that waits, and whom it answers."""

    callback: Coroutine[None, None, Any]
    service: Service
    header: Any


class NodeExecutor(SingleThreadedExecutor):
    """rclpy's executor, which knows how old a request is, and does other work while a service's callback awaits.

    request_age: s, of the request that is being answered. Read it before the first `await` of a callback.
    """

    def __init__(self, context: Context | None = None) -> None:
        super().__init__(context=context)
        self.request_age = 0.0
        self._looked = self._resumed = time.monotonic()
        self._gap = 0.0  # s for which it last stood still
        self._waiting: list[_Waiting] = []

    def add_node(self, node: Node) -> bool:
        """Guard the node's standard services, and handle its callbacks from now on."""
        guard(node)
        return bool(super().add_node(node))

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Handle one callback, and let those that wait go on; wait at most LONGEST_LOOK s, or less."""
        self._look()
        super().spin_once(LONGEST_LOOK if timeout_sec is None else min(timeout_sec, LONGEST_LOOK))
        for waiting in tuple(self._waiting):
            self._go_on(waiting)

    def _look(self) -> float:
        """Return the present time in s, and note whether this executor has stood still since the last look."""
        now = time.monotonic()
        if now - self._looked > STOOD_STILL:
            self._gap, self._resumed = now - self._looked, now
        self._looked = now
        return now

    def _age(self, header: Any) -> float:
        """Return how old a request is, in s: by its sender's clock, by its arrival, and by how long this stood still.

        Without time stamps of the middleware the last remains.
        """
        now, wall = self._look(), time.time_ns()
        stamps = getattr(header, "source_timestamp", 0), getattr(header, "received_timestamp", 0)
        queued = self._gap if now - self._resumed < QUEUED_TIME else 0.0
        return max(queued, *(1e-9 * (wall - stamp) for stamp in stamps if stamp), 0.0)

    def _take_service(self, service: Service) -> Callable[[], Coroutine[None, None, None]] | None:
        """Take a request, as rclpy does, and return what answers it."""
        try:
            with service.handle:
                request, header = service.handle.service_take_request(service.srv_type.Request)
        except rclpy_implementation.InvalidHandle:  # the service has been destroyed
            return None

        async def answer() -> None:
            if header is None:
                return
            self.request_age = self._age(header)
            response = service.callback(request, service.srv_type.Response())
            if not inspect.iscoroutine(response):
                _send(service, response, header)
                return
            self._waiting.append(_Waiting(response, service, header))
            self._go_on(self._waiting[-1])

        return answer

    def _go_on(self, waiting: _Waiting) -> None:
        try:
            waiting.callback.send(None)
        except StopIteration as end:
            self._waiting.remove(waiting)
            _send(waiting.service, end.value, waiting.header)
        except BaseException:
            self._waiting.remove(waiting)
            raise


def age_of_request(node: Node) -> float:
    """Return how old the request is that `node` is answering, in s; 0 if its executor does not know."""
    return float(getattr(node.executor, "request_age", 0.0))


def wake(node: Node) -> None:
    """Let the node's executor look at what waits, from any thread."""
    if node.executor:
        node.executor.create_task(lambda: None)


def guard(node: Node) -> None:
    """Let rclpy's own services of `node` answer a failure where their handlers raise; it is logged once."""
    said: set[str] = set()
    for service in node.services:
        if getattr(service.callback, "__module__", "").startswith("rclpy."):
            service.callback = partial(_guarded, node, said, service.srv_name, service.callback)


def prepare_transitions(node: Node, prepare: Callable[[ChangeState.Request], Coroutine[None, None, str]]) -> None:
    """Await `prepare` before each transition that the service change_state asks for; if it returns why not, refuse.

    rclpy's own handler does not await: a transition that takes long would keep the executor from everything else.
    """
    guard(node)

    async def change_state(callback: Callable[[Any, Any], Any], request: Any, response: Any) -> Any:
        if why_not := await prepare(request):
            node.get_logger().error(f"change_state: {why_not}")
            return response
        return callback(request, response)

    for service in node.services:
        if service.srv_type is ChangeState:
            service.callback = partial(change_state, service.callback)


def _guarded(
    node: Node, said: set[str], name: str, callback: Callable[[Any, Any], Any], request: Any, response: Any
) -> Any:
    try:
        return callback(request, response)
    except Exception as error:
        if _is_ours(error):
            raise
        reason = f"{name}: a request that cannot be carried out: {type(error).__name__}: {error}"
    if name not in said:
        said.add(name)
        node.get_logger().warning(reason)
    return _failure(request, response, reason)


def _is_ours(error: BaseException) -> bool:
    """Return whether this package raised it, or what this package called, and not rclpy."""
    modules, trace = [], error.__traceback__
    while trace := trace and trace.tb_next:  # without the frame that caught it
        modules.append(trace.tb_frame.f_globals.get("__name__", "").partition(".")[0])
    return [module for module in modules if module in (PACKAGE, "rclpy")][-1:] == [PACKAGE]


def _failure(request: Any, response: Any, reason: str) -> Any:
    """Return the response that says that a request to a standard service failed."""
    if isinstance(response, SetParameters.Response):  # those before the wrong one were set
        left = len(request.parameters) - len(response.results)
        response.results = [*response.results, *[SetParametersResult(successful=False, reason=reason)] * left]
    elif isinstance(response, SetLoggerLevels.Response):
        left = len(request.levels) - len(response.results)
        response.results = [*response.results, *[SetLoggerLevelsResult(successful=False, reason=reason)] * left]
    else:
        response = type(response)()  # by its defaults it is empty, or not successful
        if isinstance(response, SetParametersAtomically.Response):
            response.result.reason = reason
    return response


def _send(service: Service, response: Any, header: Any) -> None:
    """Answer a request. A sender that is gone is no reason to end the node."""
    try:
        service.send_response(response, header)
    except rclpy_implementation.RCLError as error:
        get_logger(service.logger_name).warning(f"{service.srv_name}: not answered: {error}", once=True)


def intercept_changes(node: Node, refusal: Callable[[Parameter], str], is_same: Callable[[Parameter], bool]) -> None:
    """Refuse parameters with a sentence of ours, and let others be set without any effect.

    refusal: returns why a parameter is refused, '' if it is not.
    is_same: whether a parameter is set to the value that it has. `ros2 param load` then reads a node's own dump, with
        its read-only parameters.
    """
    set_parameters = node.set_parameters_atomically

    def set_others(parameters: list[Parameter]) -> SetParametersResult:
        for reason in filter(None, map(refusal, parameters)):
            return SetParametersResult(successful=False, reason=reason)
        others = [given for given in parameters if not is_same(given)]
        return set_parameters(others) if others else SetParametersResult(successful=True)

    node.set_parameters_atomically = set_others  # which rclpy's parameter services call
