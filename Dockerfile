# A ROS 2 Jazzy host with this package, for a robot's computer or for trials in simulation.
#
#   docker build --tag exo_gravity .
#   docker run --rm exo_gravity trial demo --output /tmp/trials
#   docker run --rm --network host --stop-timeout 120 --cap-add SYS_NICE --ulimit rtprio=98 --ulimit memlock=-1 \
#       --volume /run/lock:/run/lock --volume "$PWD/my.yaml:/exo.yaml:ro" exo_gravity launcher --params /exo.yaml
#
# `docker stop` asks the container's first process alone to end, and kills all of them 10 s later. So the launcher must
# be that process: `ros2 run` (Jazzy) does not pass the request on. Letting an arm down takes up to 22 s, and 110 s if
# a process must be given up: --stop-timeout (stop_grace_period in a compose file) gives it 120 s. A CAN interface of
# the host needs --network host; the interface itself is set up on the host. Through /run/lock the next can_bridge, in
# whichever container, learns what the motors still apply.
FROM ros:jazzy-ros-base

SHELL ["/bin/bash", "-o", "pipefail", "-c"]
WORKDIR /workspace

# What rosdep installs changes less often than the sources.
COPY package.xml src/exo_gravity/package.xml
# hadolint ignore=DL3008
RUN apt-get update \
    && rosdep update --rosdistro jazzy \
    && rosdep install --from-paths src --ignore-src --rosdistro jazzy --default-yes --dependency-types exec \
    && apt-get install --yes --no-install-recommends python3-pip \
    && rm -rf /var/lib/apt/lists/*

# From PyPI: the simulator, the reports, the operator's page, orientation filter and I2C. NumPy stays
# Ubuntu's, against which ROS's messages are compiled.
COPY .ci/constraints/ros.txt constraints.txt
RUN python3 -m pip install --no-cache-dir --break-system-packages --constraint constraints.txt \
    adafruit-circuitpython-icm20x adafruit-circuitpython-lsm6ds adafruit-circuitpython-mpu6050 adafruit-extended-bus \
    mcap mujoco rosbags starlette uvicorn vqf websockets

COPY . src/exo_gravity
RUN source /opt/ros/jazzy/setup.bash && colcon build --packages-select exo_gravity

# For a terminal of its own: source /workspace/install/setup.bash
# A command runs with ROS 2 and this package sourced; the package's own commands are found by their names.
ENV PATH="/workspace/install/exo_gravity/lib/exo_gravity:$PATH"
ENTRYPOINT ["/bin/bash", "-c", "source /workspace/install/setup.bash && exec \"$@\"", "--"]
CMD ["launcher"]
