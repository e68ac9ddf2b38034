# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The inner parts of rclpy that the nodes use: here, in `PolledSubscription` and in `declare`.

Without `_take_service` a request is as old as the executor stood still.

rclpy's handlers of the standard services raise on some wrong requests, and an exception in an executor ends the node.
So `guard` lets them answer a failure. An exception of this package still ends the node, which lets the arm down.
"""

import time
from collections.abc import Callable, Coroutine, Generator
from contextlib import suppress
from functools import partial
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor, await_or_execute
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.service import Service

STOOD_STILL = 1.0  # s between two looks at what is due, after which an executor has stood still
QUEUED_TIME = 0.5  # s after that in which requests may have been queued meanwhile
REQUEST_LIFE = 1.0  # s; a busy computer delays requests by tenths of that
PACKAGE = __name__.partition(".")[0]


class Until:
    """Awaits `is_done()`, for at most `timeout` s. An executor looks when it does other work, and ten times a second.

    The callback that awaits needs a ReentrantCallbackGroup, or its node does nothing else meanwhile.
    """

    def __init__(self, is_done: Callable[[], object], timeout: float) -> None:
        self._is_done, self._end = is_done, time.monotonic() + timeout

    def __await__(self) -> Generator[None, None, None]:
        """Yield until it is done."""
        while not self._is_done() and time.monotonic() < self._end:
            yield


class NodeExecutor(SingleThreadedExecutor):
    """rclpy's executor, which knows how old a request is.

    request_age: s, of the request that is being answered. Read it before the first `await` of a callback.
    """

    def __init__(self, context: Context | None = None) -> None:
        super().__init__(context=context)
        self.request_age = 0.0
        self._looked = self._resumed = time.monotonic()
        self._gap = 0.0  # s for which it last stood still

    def add_node(self, node: Node) -> bool:
        """Guard the node's standard services, and handle its callbacks from now on."""
        guard(node)
        return bool(super().add_node(node))

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Handle one callback."""
        self._look()
        super().spin_once(timeout_sec)

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
        """Take a request, as rclpy does, and return what answers it. A sender that is gone does not end the node."""
        try:
            with service.handle:
                request, header = service.handle.service_take_request(service.srv_type.Request)
        except rclpy_implementation.InvalidHandle:  # the service has been destroyed
            return None

        async def answer() -> None:
            if header is not None:
                self.request_age = self._age(header)
                response = await await_or_execute(service.callback, request, service.srv_type.Response())
                with suppress(rclpy_implementation.RCLError):
                    service.send_response(response, header)

        return answer


def why_too_old(node: Node) -> str:
    """Return why the request that `node` is answering is too old to move an arm; '' if it is not, or that is not known.

    Its sender no longer expects it to be carried out.
    """
    age = getattr(node.executor, "request_age", 0.0)
    if age <= REQUEST_LIFE:
        return ""
    return (
        f"refused: the request is {age:.1f} s old, must be at most {REQUEST_LIFE:g} s: send it again; if it comes from "
        "another computer, compare the clocks"
    )


def wake(node: Node) -> None:
    """Let the node's executor look at what waits, from any thread."""
    if node.executor:
        node.executor.create_task(lambda: None)


def guard(node: Node) -> None:
    """Let rclpy's own services of `node` answer a failure where their handlers raise; it is logged now and then."""
    for service in node.services:
        if getattr(service.callback, "__module__", "").startswith("rclpy."):
            service.callback = partial(_guarded, node, service.srv_name, service.callback)


def prepare_transitions(node: Node, prepare: Callable[[Any], Coroutine[None, None, str]]) -> None:
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
        if service.srv_name.endswith("/change_state"):
            service.callback = partial(change_state, service.callback)
            service.callback_group = ReentrantCallbackGroup()


def _guarded(node: Node, name: str, callback: Callable[[Any, Any], Any], request: Any, response: Any) -> Any:
    try:
        return callback(request, response)
    except Exception as error:
        if _is_ours(error):
            raise
        reason = f"{name}: a request that cannot be carried out: {type(error).__name__}: {error}"
    node.get_logger().warning(reason, throttle_duration_sec=60.0)
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
    else:
        response = type(response)()  # by its defaults it is empty, or not successful
        if isinstance(response, SetParametersAtomically.Response):
            response.result.reason = reason
    return response
