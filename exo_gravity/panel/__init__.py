# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The operator's panel without ROS: who may use it, who holds control, its page and its web server."""
