"""A process that writes a recording until it is killed, for test/lab/bag/test_writer.py.

    python -m test.support.bag_processes PATH

It prints the time stamp in ns of each message that it hands to the writer.
"""

from __future__ import annotations

import sys
import time

from exo_gravity.lab.bag.writer import BagWriter, offered_qos

from .synthetic_bags import JOINT_STATE, NAMES, joint_state

TOPIC = "/right/joint_states"
SLOW = 0.2  # s between messages: so slow that no buffer fills up and is flushed

if __name__ == "__main__":
    writer = BagWriter(sys.argv[1])
    writer.add_topic(TOPIC, JOINT_STATE, offered_qos(True, False, 1))
    while True:
        now = time.time_ns()
        writer.write([(TOPIC, now, joint_state(now, NAMES, [0.1] * 4, [0.2] * 4, [0.3] * 4))])
        print(now, flush=True)
        time.sleep(SLOW)
