"""Processes that write a recording under bad conditions, for test/bag/test_writer.py.

    python -m test.support.bag_processes until_killed|until_disk_full PATH

`until_killed` prints the time stamp in ns of each message that it hands to the writer. `until_disk_full` limits the
size of its files, writes until the writer stops, and prints the writer's error.
"""

from __future__ import annotations

import resource
import sys
import time

from exo_gravity.bag.writer import BagWriter, offered_qos

from .synthetic_bags import JOINT_STATE, NAMES, START, joint_state

TOPIC = "/right/joint_states"
SLOW = 0.2  # s between messages: so slow that no buffer fills up and is flushed
FILE_SIZE_LIMIT = 200_000  # bytes


def open_writer(path: str) -> BagWriter:
    writer = BagWriter(path)
    writer.add_topic(TOPIC, JOINT_STATE, offered_qos(True, False, 1))
    return writer


def write(writer: BagWriter, stamp: int) -> None:
    writer.write([(TOPIC, stamp, joint_state(stamp, NAMES, [0.1] * 4, [0.2] * 4, [0.3] * 4))])


def until_killed(path: str) -> None:
    writer = open_writer(path)
    while True:
        now = time.time_ns()
        write(writer, now)
        print(now, flush=True)
        time.sleep(SLOW)


def until_disk_full(path: str) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_SIZE_LIMIT, FILE_SIZE_LIMIT))
    writer = open_writer(path)
    for k in range(2_000):
        if writer.error:
            break
        write(writer, START + k * 1_000_000)
    writer.close()
    print(writer.error)


if __name__ == "__main__":
    {"until_killed": until_killed, "until_disk_full": until_disk_full}[sys.argv[1]](sys.argv[2])
