# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Recordings in and out: `reader.read_bag` turns a rosbag2 recording into arrays, `writer.BagWriter` makes one."""
