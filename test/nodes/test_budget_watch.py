"""The thread that computes torque budgets."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor

from exo_gravity.core import ArmModel
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE
from exo_gravity.nodes.compensator.watches import BRIDGE_PARAMETERS, WITHIN, compute

ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
BRIDGE = values_of([param for param in CAN_BRIDGE if param.name in BRIDGE_PARAMETERS], {})


def test_a_budget_never_runs_with_the_policy_that_thread_priority_gives_to_all_threads():
    request = ROBOT, ((0.0,) * 4, (0.0,) * 4), 0.0, 0.0
    with ThreadPoolExecutor(1) as pool:
        thread = pool.submit(threading.get_native_id).result()
        # SCHED_BATCH needs no permission, and is inherited and set as SCHED_FIFO is.
        os.sched_setscheduler(thread, os.SCHED_BATCH, os.sched_param(0))
        result = pool.submit(compute, ("a", "b", "c", "d"), request, BRIDGE).result()
        assert os.sched_getscheduler(thread) == os.SCHED_OTHER
    assert result == (WITHIN, "none")
