# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rows of recordings: reading against rosbags and mcap's own reader."""

import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from exo_gravity.lab.bag.content import JOINT_STATE
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.inputs.parameter_file import packaged_config

from .table import Row, race

RATE, BEGIN = 500, 1_700_000_000  # Hz of the recordings, s since 1970
FORMS = {
    "MCAP": (StoragePlugin.MCAP, None),
    "MCAP, zstd": (StoragePlugin.MCAP, CompressionMode.STORAGE),
    "sqlite3": (StoragePlugin.SQLITE3, None),
}


def measure_recordings(quick: bool) -> Iterator[Row]:
    """Yield the rows of recordings."""
    repeats, seconds = (3, 20) if quick else (5, 120)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number, (form, (plugin, compression)) in enumerate(FORMS.items()):
            bag = write_recording(folder / f"form_{number}", seconds, plugin, compression)
            peers: dict[str, Callable[[], object]] = {"rosbags": partial(_read_by_rosbags, bag)}
            if plugin is StoragePlugin.MCAP:
                peers["mcap's own reader"] = partial(_read_by_mcap, bag)
            with Reader(bag) as reader:
                size = sum(len(data) for _, _, data in reader.messages()) / 1e6  # MB
            calls: list[Callable[[], object]] = [partial(read_bag, bag), *peers.values()]
            first, *others = race([(call, 1) for call in calls], repeats)
            for peer, taken in zip(peers, others, strict=True):
                fast, other = ([size / spent for spent in column] for column in (first, taken))
                yield Row.of_values(f"reading, {form}: {peer}", fast, other, "MB/s", more_is_better=True)


def write_recording(
    path: Path,
    seconds: int,
    plugin: StoragePlugin,
    compression: CompressionMode | None,
) -> Path:
    """Write a rosbag2 of an arm that moves to a pose and holds it, four times a minute."""
    store = get_typestore(Stores.ROS2_JAZZY)
    header, stamp = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    names = yaml.safe_load(packaged_config("sim.yaml").read_text())["/right/compensator"]["ros__parameters"]
    rng = np.random.default_rng(1)
    writer = Writer(path, version=9, storage_plugin=plugin)
    if compression:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        states, commands = (
            writer.add_connection(f"/right/{topic}", JOINT_STATE, typestore=store)
            for topic in ("joint_states", "effort_commands")
        )
        for index in range(seconds * RATE):
            at = BEGIN * 10**9 + index * 10**9 // RATE
            when = header(stamp(*divmod(at, 10**9)), "")
            moving = 0.3 * np.sin(min(index / RATE % 15.0, 3.0) * np.ones(4)) + 1e-4 * rng.standard_normal(4)
            for connection, arrays in ((states, (moving, np.zeros(4), moving)), (commands, ([], [], moving))):
                message = store.types[JOINT_STATE](when, names["joint_names"], *map(np.asarray, arrays))
                writer.write(connection, at, bytes(store.serialize_cdr(message, JOINT_STATE)))
    return path


def _read_by_rosbags(bag: Path) -> None:
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)


def _read_by_mcap(bag: Path) -> None:
    (file,) = bag.glob("*.mcap")
    with file.open("rb") as stream:
        for _ in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            pass
