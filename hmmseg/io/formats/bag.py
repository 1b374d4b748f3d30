"""ROS 1 bags (.bag) and ROS 2 bags (a folder with metadata.yaml), read with rosbags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from hmmseg.errors import InputError
from hmmseg.io.formats.messages import Stream, joined, topic_wanted
from hmmseg.io.table import Table


def read(path: Path, part: str | None, wanted: Sequence[str] | None) -> Table:
    """The wanted columns on one clock."""
    return joined(str(path), read_streams(path, wanted), wanted)


def read_streams(path: Path, wanted: Sequence[str] | None = None) -> list[Stream]:
    """Every topic's messages; of topics that are not wanted only the first."""
    folder = path.parent if path.suffix.lower() == ".db3" else path
    if folder is not path and not (folder / "metadata.yaml").is_file():
        raise InputError(str(path), "has no metadata.yaml beside it", "the folder of a ROS 2 bag")
    streams: dict[str, Stream] = {}
    with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, logged, data in reader.messages():
            stream = streams.setdefault(connection.topic, Stream(connection.topic, connection.msgtype))
            if not stream.values or topic_wanted(connection.topic, wanted):
                stream.add(logged, reader.deserialize(data, connection.msgtype))
    return list(streams.values())
