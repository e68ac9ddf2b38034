"""Recordings in and out: `reader.read_bag` turns a rosbag2 recording into arrays, `writer.BagWriter` makes one."""
