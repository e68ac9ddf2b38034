# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the nodes share of ROS: parameters, topics, diagnostics, start and stop."""
