# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The commands that the documents show, and what is known of each: what runs it, or why nothing here can."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]

SUCCESS, RIGHT = "Set parameter successful", "/right/compensator"
HOLD = "ros2 topic pub -r 5 /right/can_bridge/control diagnostic_msgs/msg/KeyValue"
CALL = "ros2 service call /right/can_bridge"
# Those of `ros2`, in an order in which a simulated arm that is not yet configured answers each, with what it prints.
# test/nodes/ros2_launch.py types them.
ROS2 = {
    "SHARE=$(ros2 pkg prefix --share exo_gravity)": "",
    "python3 $(ros2 pkg prefix --share exo_gravity)/config/sros2/policy.py > policy.xml": "",
    "ros2 lifecycle set /right/can_bridge configure": "Transitioning successful",
    "ros2 lifecycle set /right/can_bridge activate": "Transitioning successful",
    "ros2 topic echo /diagnostics": "name: right/can_bridge",
    "ros2 topic echo /diagnostics --field status": "right/can_bridge",
    "ros2 topic echo /right/effort_commands --field effort": r"array\('d', \[",
    "ros2 param set /right/simulator trial $SHARE/config/trials/two_poses.yaml": SUCCESS,
    f"ros2 param set {RIGHT} support 0.1": SUCCESS,
    f'ros2 param set {RIGHT} gain "[1.0, 0.9, 1.0, 1.0]"': SUCCESS,
    f'ros2 param set {RIGHT} robot.mass "[0.5, 0.4, 0.6]"': "failed: robot.mass = .* must be 4 numbers",
    f"ros2 param describe {RIGHT} max_effort": r"torque limit per joint \[Nm\]",
    f"ros2 param set {RIGHT} wearer.body_mass 75.0": SUCCESS,
    f"ros2 param set {RIGHT} support 0.01": SUCCESS,
    f"ros2 param set {RIGHT} mode zero_g": SUCCESS,
    f"ros2 param set {RIGHT} payload.mass 0.973": SUCCESS,
    f"ros2 param set {RIGHT} support_adapts true": SUCCESS,
    f'ros2 param set {RIGHT} shoulder_from_imu "[0.12, -0.2, 0.1]"': SUCCESS,
    f"ros2 param set {RIGHT} inertial true": SUCCESS,
    f'ros2 param set {RIGHT} assist.max_effort "[1.0, 1.0, 1.0, 1.0]"': SUCCESS,
    f'{CALL}/enable std_srvs/srv/SetBool "{{data: false}}"': "success=True, message='the motors are switched off once",
    f'{CALL}/enable std_srvs/srv/SetBool "{{data: true}}"': "success=True, message='torque follows in",
    'ros2 param set /right/simulator fault.temperature "[30.0, 90.0, 30.0, 30.0]"': SUCCESS,
    'ros2 param set /right/simulator fault.temperature "[30.0, 30.0, 30.0, 30.0]"': SUCCESS,
    f"{CALL}/clear_fault std_srvs/srv/Trigger": "success=True",
    f'{HOLD} "{{key: anna, value: hold}}"': "publishing #3",
}
ELSEWHERE = {  # by their beginnings: what runs them, or what they need that no test has
    "ros2 launch exo_gravity exo.launch.py": "other tests of test/nodes/ros2_launch.py",
    "ros2 service call /arm/compensator/clear_fault": "test/nodes/test_compensator.py, over the service",
    "ros2 service call /right/compensator/weigh": "test/nodes/test_compensator.py, over the service",
    "ros2 launch exo_gravity view.launch.py": "ros-jazzy-rviz2 and ros-jazzy-robot-state-publisher",
    "ros2 security": "ros-jazzy-sros2",
    "ROS_SECURITY_ENCLAVE_OVERRIDE=": "ros-jazzy-sros2",
    "ros2 topic pub -w 1 --once /event_marker": "test/nodes/test_recorder.py, over the topic",
    "ros2 bag record": "ros-jazzy-ros2bag; the reader's tests read such recordings",
    "ros2 control": "ros2_control and its hardware",
    "ros2 run diagnostic_aggregator": "ros-jazzy-diagnostic-aggregator",
    "ros2 run rqt_robot_monitor": "ros-jazzy-rqt-robot-monitor",
    "ros2 run plotjuggler": "ros-jazzy-plotjuggler-ros",
    "ros2 launch foxglove_bridge": "ros-jazzy-foxglove-bridge",
    "sudo": "the computer's own set-up",
    "export": "the computer's own set-up",
    "colcon": "ROS; the workflow ros.yml runs it",
    "pip install": "the workflow ci.yml",
    ".ci/": "continuous integration",
    ". .venv/bin/activate": "every test runs in it",
    "PROCESS=$(pgrep -x compensator); kill -STOP": "the fault matrix, by process ID",
    "kill -9 $(pgrep -x can_bridge)": "the fault matrix, by process ID",
    "for enclave in": "ros-jazzy-sros2",
    "done": "ros-jazzy-sros2",
    "python examples/": "test/test_examples.py",
}
