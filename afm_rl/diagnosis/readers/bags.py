"""MCAP files, and the bags of ROS."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from afm_rl.diagnosis.readers.messages import Field, fields_of, series_of
from afm_rl.diagnosis.readers.source import Series, Source, check_regular
from afm_rl.errors import ConfigurationError, printable

MISSING = "needs {}: pip install 'afm-rl[logs]'"
Messages = Iterator[tuple[str, float, Any]]
"""Topic, time (s) and content."""


def open_mcap(path: Path) -> Source:
    """Return the fields of an MCAP file whose messages are those of ROS 2, or JSON.

    Raises:
        ConfigurationError: if it cannot be read.
    """
    try:
        from mcap.reader import make_reader
    except ImportError as error:
        raise ConfigurationError(f"an MCAP file {MISSING.format('mcap')}") from error

    def messages(topics: Collection[str] | None) -> Messages:
        decoders: dict[int, Any] = {}
        with _reading("MCAP file"), path.open("rb") as file:
            reader = make_reader(file)
            for schema, channel, message in reader.iter_messages(topics):
                if channel.id not in decoders:
                    decoders[channel.id] = _decoder(schema, channel.message_encoding)
                decode = decoders[channel.id]
                if decode is not None:
                    yield channel.topic, message.log_time / 1e9, decode(message.data)

    return _source(path, messages)


def open_bag(path: Path) -> Source:
    """Return the fields of a bag of ROS 2 (a folder, or ``.db3``), or of ROS 1 (``.bag``).

    Raises:
        ConfigurationError: if it cannot be read.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ConfigurationError(f"a bag of ROS {MISSING.format('rosbags')}") from error
    if path.is_dir():
        for part in path.iterdir():
            check_regular(part)

    def messages(topics: Collection[str] | None) -> Messages:
        with _reading("bag of ROS"):
            types = get_typestore(Stores.LATEST)  # of bags that have none
            with AnyReader([path], default_typestore=types) as bag:
                wanted = [c for c in bag.connections if topics is None or c.topic in topics]
                for connection, t, data in bag.messages(wanted) if wanted else ():
                    yield connection.topic, t / 1e9, bag.deserialize(data, connection.msgtype)

    return _source(path, messages)


def _source(path: Path, messages: Any, looked_at: int = 20) -> Source:
    """Return a source of messages: a first pass finds the fields, in some of each topic.

    Of one alone it would not: joints may come in turns.
    """
    fields: dict[str, tuple[str, Field]] = {}
    counts: dict[str, int] = {}
    for topic, _, content in messages(None):
        counts[topic] = counts.get(topic, 0) + 1
        if counts[topic] <= looked_at:
            fields |= {f"{topic}{name}": (topic, way) for name, way in fields_of(content)}

    def read(wanted: Sequence[str]) -> dict[str, Series]:
        chosen = {name: fields[name] for name in wanted}
        return series_of(messages({topic for topic, _ in chosen.values()}), chosen)

    return Source(path, list(fields), read, topics=counts)


def _decoder(schema: Any, encoding: str) -> Any:
    """Return what makes an object of a message's bytes, or None if nothing here can."""
    if encoding == "json":
        return json.loads
    if encoding != "cdr" or schema is None:
        return None
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    text = schema.data.decode()
    if schema.encoding == "ros2idl":
        store.register(get_types_from_idl(text))
    else:
        store.register(get_types_from_msg(text, schema.name))
    return lambda data: store.deserialize_cdr(data, schema.name)


@contextmanager
def _reading(what: str) -> Iterator[None]:
    """Turn an error of the reader into one line: of damaged bytes it may be of any kind."""
    try:
        yield
    except (GeneratorExit, ConfigurationError, MemoryError):
        raise
    except Exception as error:
        reason = printable(f"{type(error).__name__}: {error}", 120)
        raise ConfigurationError(f"no {what}, or a damaged one: {reason}") from error
