"""The thread that computes the torque budget."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor

import rclpy

from exo_gravity.core import ArmModel
from exo_gravity.nodes.compensator.budget_watch import WITHIN, BudgetWatch

ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))


def test_a_budget_never_runs_with_the_policy_that_thread_priority_gives_to_all_threads():
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("compensator", context=context)
    try:
        watch = BudgetWatch(node, ("a", "b", "c", "d"), 0.0)
        watch._bridge = []  # the bridge's defaults
        with ThreadPoolExecutor(1) as pool:
            thread = pool.submit(threading.get_native_id).result()
            # SCHED_BATCH needs no permission, and is inherited and set as SCHED_FIFO is.
            os.sched_setscheduler(thread, os.SCHED_BATCH, os.sched_param(0))
            sentence = pool.submit(watch._sentence, ROBOT, (0.0,) * 4, (0.0,) * 4, 0.0).result()
            assert os.sched_getscheduler(thread) == os.SCHED_OTHER
        assert sentence == WITHIN
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)
