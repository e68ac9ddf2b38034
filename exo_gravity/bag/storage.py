"""Serialised messages out of a rosbag2 recording, in batches: MCAP or sqlite3, whole or cut short.

A recorder that was killed leaves no metadata.yaml and no index, so neither is needed: an MCAP file is read record after
record, a database row after row, and what is there is yielded. Recordings that rosbag2 compressed as a whole or message
by message are left to rosbags' own reader, which wants them whole.
"""

from __future__ import annotations

import re
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO
from urllib.parse import quote

from rosbags.rosbag2 import Reader, ReaderError

from exo_gravity.bag.mcap import Batch, McapMessages, Wanted
from exo_gravity.core.errors import DataError

ROWS = 5_000  # messages a batch
Topic = tuple[str, str]  # name, type
Row = tuple[Topic, int, bytes]


class Storage:
    """A recording: a folder of rosbag2, or one of its files.

    Filled while `batches` is read: `topics`, type by topic, wanted or not; `cut_short`, what was wrong with the end of
    the last file, None if nothing; `done` of `size` bytes.
    """

    def __init__(self, path: str | Path):
        """Find the files. Raises DataError if there is none."""
        self.path = Path(path)
        self.topics: dict[str, str] = {}
        self.cut_short: str | None = None
        self.done = 0
        if not self.path.exists():
            raise DataError(f"{path}: no such file or folder")
        files = sorted(self.path.iterdir(), key=_natural) if self.path.is_dir() else [self.path]
        self.files = [file for file in files if file.suffix in (".mcap", ".db3", ".zstd")]
        if not self.files:
            raise DataError(f"{path}: must be a rosbag2 recording, a folder with an .mcap or .db3 file, or such a file")
        self.size = sum(file.stat().st_size for file in self.files)

    def batches(self, wanted: Wanted) -> Iterator[Batch]:
        """Yield the messages of the topics that are `wanted`. Raises DataError where a file is of no known form."""
        if any(file.suffix == ".zstd" for file in self.files) or self._compressed_messages():
            yield from self._by_rosbags(wanted)
            return
        for file in self.files:
            before = self.done
            yield from self._mcap(file, wanted) if file.suffix == ".mcap" else self._sqlite(file, wanted)
            self.done = before + file.stat().st_size

    def _compressed_messages(self) -> bool:
        metadata = self.path / "metadata.yaml"
        text = metadata.read_text(encoding="utf-8") if metadata.is_file() else ""
        return re.search(r"^\s*compression_mode:\s*['\"]?message", text, re.MULTILINE | re.IGNORECASE) is not None

    def _mcap(self, file: Path, wanted: Wanted) -> Iterator[Batch]:
        before = self.done
        with file.open("rb") as stream:
            reader = McapMessages(stream, self.topics, wanted)
            for batch in reader.batches():
                self.done = before + stream.tell()
                yield batch
        if reader.cut_short:
            self.cut_short = f"{file.name} {reader.cut_short}"

    def _sqlite(self, file: Path, wanted: Wanted) -> Iterator[Batch]:
        try:
            database, topics = _open_database(file)
        except sqlite3.Error as error:
            raise DataError(f"{file}: must be a database of rosbag2 ({error})") from None
        self.topics.update(topics.values())
        chosen = {key: topic for key, topic in topics.items() if wanted(*topic)}
        for batch in _grouped(self._rows(database, chosen, file.name)):
            self.done += sum(map(len, batch.data))
            yield batch
        database.close()

    def _rows(self, database: sqlite3.Connection, chosen: dict[int, Topic], name: str) -> Iterator[Row]:
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({','.join('?' * len(chosen))})"
        try:
            for key, stamp, data in database.execute(query, list(chosen)):
                yield chosen[key], stamp, data
        except sqlite3.Error as error:  # the rows before the damage have been yielded
            self.cut_short = f"{name} {error}"

    def _by_rosbags(self, wanted: Wanted) -> Iterator[Batch]:
        try:
            with Reader(self.path) as reader:
                self.topics.update((c.topic, c.msgtype) for c in reader.connections)
                chosen = [c for c in reader.connections if wanted(c.topic, c.msgtype)]
                messages = reader.messages(chosen) if chosen else ()
                yield from _grouped(((c.topic, c.msgtype), stamp, bytes(data)) for c, stamp, data in messages)
        except (ReaderError, FileNotFoundError) as error:
            raise DataError(f"{self.path}: a compressed recording must be whole ({error})") from None


def _grouped(rows: Iterator[Row]) -> Iterator[Batch]:
    while part := list(islice(rows, ROWS)):
        batches: dict[str, Batch] = {}
        for topic, stamp, data in part:
            batch = batches.get(topic[0]) or batches.setdefault(topic[0], Batch(*topic, [], []))
            batch.stamps.append(stamp)
            batch.data.append(data)
        yield from batches.values()


def _open_database(file: Path) -> tuple[sqlite3.Connection, dict[int, Topic]]:
    """Return the database and its topics. sqlite3.Error if that can't be had in any of three ways."""
    with tempfile.NamedTemporaryFile(suffix=file.suffix) as copy:
        # A recorder that was killed may leave a journal, which sqlite plays back where it may write beside the file.
        for name, mode in ((file, "mode=ro"), (file, "immutable=1"), (copy.name, "immutable=1")):
            if name == copy.name:
                _copy_as_long_as_it_is(file, copy)
            database = sqlite3.connect(f"file:{quote(str(Path(name).resolve()))}?{mode}", uri=True)
            try:
                rows = database.execute("SELECT id, name, type FROM topics").fetchall()
                return database, {key: (topic, kind) for key, topic, kind in rows}
            except sqlite3.Error as error:
                database.close()
                failure = error
        raise failure


def _copy_as_long_as_it_is(file: Path, copy: BinaryIO) -> None:
    """Copy a database that ends before the size in its header, without which sqlite goes by the size of the file.

    The size is valid if the counter at byte 92 equals the one at 24 (https://www.sqlite.org/fileformat.html, 1.3.7).
    """
    with file.open("rb") as original:
        shutil.copyfileobj(original, copy)
    copy.seek(24)
    counter = copy.read(4)
    copy.seek(92)
    copy.write(bytes(byte ^ 0xFF for byte in counter))
    copy.flush()


def _natural(path: Path) -> list:
    """Order bag_2 before bag_10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]
