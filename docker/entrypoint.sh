#!/usr/bin/env bash
# Runs a command with ROS 2 and this package sourced; the package's own commands are found by their names.
set -e
# shellcheck source=/dev/null
source /workspace/install/setup.bash
export PATH="/workspace/install/exo_gravity/lib/exo_gravity:$PATH"
exec "$@"
