# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The nodes, the only modules that import rclpy: without it each ends with one sentence, also with `--help`."""

import sys
from pathlib import Path

from exo_gravity import require_ros

require_ros(Path(sys.argv[0]).name)
