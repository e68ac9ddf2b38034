# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""CONTRIBUTING, "Add a topic", followed literally: a topic of an arm, with an entry in the recorder's table."""

import signal
import subprocess
import sys

from rosbags.highlevel import AnyReader
from std_msgs.msg import Float64

from exo_gravity.lab.bag.content import arm_of, leaf

from ..support.waiting import PATIENCE, wait_until

RECORDER = """
from std_msgs.msg import Float64
from exo_gravity.nodes.recorder import node
node.TYPES["grip_force"] = Float64
node.main()
"""


def test_a_new_topic_is_recorded_in_the_arms_namespace(executor, tmp_path):
    (node,) = executor.get_nodes()
    publisher = node.create_publisher(Float64, "/left/grip_force", 1)
    command = [sys.executable, "-c", RECORDER, "--ros-args", "-p", f"output:={tmp_path / 'bag'}"]
    recorder = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        wait_until(publisher.get_subscription_count, lambda: executor.spin_once(timeout_sec=0.01))
        publisher.publish(Float64(data=12.5))
        wait_until(lambda: publisher.wait_for_all_acked(), lambda: executor.spin_once(timeout_sec=0.01))
    finally:
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait(PATIENCE) == 0
    with AnyReader([tmp_path / "bag"]) as bag:
        (connection,) = [each for each in bag.connections if leaf(each.topic) == "grip_force"]
        messages = [bag.deserialize(data, connection.msgtype) for _, _, data in bag.messages([connection])]
    assert arm_of(connection.topic) == "left"
    assert [message.data for message in messages] == [12.5]
