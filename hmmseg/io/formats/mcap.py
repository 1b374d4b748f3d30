"""MCAP logs: ROS 2 messages and JSON, read with the field's own library."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from hmmseg.errors import InputError
from hmmseg.io.formats.messages import Stream, joined, topic_wanted
from hmmseg.io.table import Table


def read(path: Path, part: str | None, wanted: Sequence[str] | None) -> Table:
    """The wanted columns on one clock."""
    return joined(str(path), read_streams(path, wanted), wanted)


def read_streams(path: Path, wanted: Sequence[str] | None = None) -> list[Stream]:
    """Every topic's messages; of topics that are not wanted only the first."""
    streams: dict[str, Stream] = {}
    factory = DecoderFactory()
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            stream = streams.setdefault(channel.topic, Stream(channel.topic, schema.name if schema else ""))
            if stream.values and not topic_wanted(channel.topic, wanted):
                continue
            if channel.message_encoding == "json":
                decoded = json.loads(message.data)
            else:
                decode = factory.decoder_for(channel.message_encoding, schema)
                if decode is None:
                    if topic_wanted(channel.topic, wanted) and wanted is not None:
                        raise InputError(f"{path}: topic {channel.topic}", "is encoded as "
                                         f"{channel.message_encoding!r}", "cdr (ROS 2) or json")  # fmt: skip
                    continue
                decoded = decode(message.data)
            stream.add(message.log_time, decoded)
    return list(streams.values())
