#!/usr/bin/env bash
# Runs a command with ROS 2 and this package sourced.
set -e
# shellcheck source=/dev/null
source /workspace/install/setup.bash
exec "$@"
