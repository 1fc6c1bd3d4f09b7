"""Logs of messages, as series of numbers: MCAP, bags of ROS, PX4's ULog."""

from __future__ import annotations

import dataclasses
import io
import json
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, redirect_stdout
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pandas as pd

from afm_rl.diagnosis.readers.source import NAMES, WIDEST, Source, check_regular
from afm_rl.errors import ConfigurationError, printable, refusing
from afm_rl.imports import needs

Field = tuple[str | int, ...]
"""The way to a number: attributes, keys, places in arrays."""

Messages = Iterator[tuple[str, float, Any]]
"""Topic, time (s) and content."""
TIME = "timestamp"  # in microseconds
POSE = "\n".join(f"float32 {n}" for n in "x y theta linear_velocity angular_velocity".split())
"""Of turtlesim, whose bags do not say what it is."""
CHUNK = 1 << 26
"""Most bytes that a chunk of an MCAP file unpacks to."""


def fields_of(message: Any, depth: int = 8, most: int = 64) -> Iterator[tuple[str, Field]]:
    """Yield name and way of each number in a message.

    Where a list ``name`` has as many entries as an array beside it, these are its names, as in
    ROS's ``JointState``. Of an array of more than ``most`` numbers, as of an image, none is named.

    >>> message = {"name": ["pan"], "position": [0.5], "header": {"stamp": 3}}
    >>> [name for name, _ in fields_of(message)]
    ['.position[pan]', '.header.stamp']
    """
    parts = _parts(message)
    labels = parts.get("name")
    labels = labels if isinstance(labels, list) and all(type(x) is str for x in labels) else []
    for key, value in parts.items():
        if isinstance(value, bool | int | float | np.number | np.bool_):
            yield f".{key}", (key,)
        elif isinstance(value, list | tuple | np.ndarray) and 0 < len(value) <= most:
            named = labels if len(labels) == len(value) and value is not labels else []
            for place, entry in enumerate(value):
                shown = named[place] if named else place
                way: Field = (key, shown)
                if isinstance(entry, bool | int | float | np.number):
                    yield f".{key}[{shown}]", way
                elif depth:
                    inner = fields_of(entry, depth - 1)
                    yield from ((f".{key}[{place}]{n}", (key, place, *w)) for n, w in inner)
        elif depth:
            yield from ((f".{key}{n}", (key, *w)) for n, w in fields_of(value, depth - 1))


def value_at(message: Any, way: Field) -> float | None:
    """Return the number at a place of a message, None where there is none.

    >>> value_at({"name": ["a", "b"], "position": [1.0, 2.0]}, ("position", "b"))
    2.0
    """
    parent: Any = None
    try:
        for step in way:
            if isinstance(message, list | tuple | np.ndarray):
                place = _get(parent, "name").index(step) if isinstance(step, str) else step
                message = message[place]
            else:
                parent, message = message, _get(message, step)
        return float(message)
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError):
        return None


def series_of(
    messages: Iterable[tuple[str, float, Any]], wanted: Mapping[str, tuple[str, Field]]
) -> dict[str, pd.Series]:
    """Return the series of fields: a message without a field, as of another publisher, is none."""
    by_topic: dict[str, list[str]] = {}
    for name, (topic, _) in wanted.items():
        by_topic.setdefault(topic, []).append(name)
    rows: dict[str, list[tuple[float, float]]] = {name: [] for name in wanted}
    for topic, t, content in messages:
        for name in by_topic[topic]:
            value = value_at(content, wanted[name][1])
            rows[name] += [] if value is None else [(value, t)]
    table = {name: np.array(pairs).reshape(-1, 2) for name, pairs in rows.items()}
    return {name: sorted_series(*pairs.T) for name, pairs in table.items()}


def sorted_series(values: np.ndarray, t: np.ndarray) -> pd.Series:
    """Return values by their times, in order, the last one of each time.

    >>> sorted_series(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.2, 0.0])).to_dict()
    {0.0: 3.0, 0.2: 2.0}
    """
    return pd.Series(values, t).groupby(level=0).last()


def _parts(message: Any) -> Mapping[str, Any]:
    if isinstance(message, Mapping):
        return {str(key): value for key, value in message.items()}
    every = dataclasses.fields(message) if dataclasses.is_dataclass(message) else ()
    names = [field.name for field in every if field.default is dataclasses.MISSING]  # no constant
    return {name: getattr(message, name) for name in names if not name.startswith("__")}


def _get(message: Any, key: Any) -> Any:
    return message[key] if isinstance(message, Mapping) else getattr(message, key)


def open_mcap(path: Path) -> Source:
    """Return the fields of an MCAP file whose messages are those of ROS, or JSON."""
    needs("an MCAP file", "mcap", "logs")
    from mcap.records import Channel, Message, Schema

    def messages(topics: Collection[str] | None) -> Messages:
        schemas: dict[int, Any] = {}
        channels: dict[int, tuple[str, Any]] = {}  # topic, and what decodes its messages
        with refusing("no MCAP file, or a damaged one"), path.open("rb") as file:
            for record in _records(file, path.stat().st_size):
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel) and record.id not in channels:
                    decode = _decoder(schemas.get(record.schema_id), record.message_encoding)
                    channels[record.id] = record.topic, decode
                elif isinstance(record, Message):
                    topic, decode = channels[record.channel_id]
                    if topics is None or topic in topics:  # of what cannot be decoded, no fields
                        yield topic, record.log_time / 1e9, decode(record.data) if decode else {}

    return _source(path, messages)


def _records(file: BinaryIO, size: int) -> Iterator[Any]:
    """Yield the records of an MCAP file, those of its chunks among them, in the file's order."""
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader, breakup_chunk

    ratio = 100  # most bytes in all for each byte of the file
    budget = (1 << 24) + ratio * size
    for record in StreamReader(file, emit_chunks=True).records:
        if isinstance(record, Chunk):
            most = min(budget, CHUNK)
            data = _unpacked(record.data, record.compression, most + 1)
            if len(data) > most:
                raise ConfigurationError(
                    f"a chunk unpacks to more than {most:,} bytes: expected at most {CHUNK:,}, and "
                    f"{ratio} times the file's size in all"
                )
            budget -= len(data)
            yield from breakup_chunk(replace(record, data=data, compression=""))
        else:
            yield record


def _unpacked(data: bytes, compression: str, most: int) -> bytes:
    """Return the first bytes that packed ones stand for, at most so many."""
    import lz4.frame
    import zstandard

    if not compression:
        return data
    with {"lz4": lz4.frame.open, "zstd": zstandard.open}[compression](io.BytesIO(data)) as file:
        return file.read(most)


def open_bag(path: Path) -> Source:
    """Return the fields of a bag of ROS 2 (a folder, or ``.db3``), or of ROS 1 (``.bag``)."""
    needs("a bag of ROS", "rosbags", "logs")
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    for part in path.iterdir() if path.is_dir() else (path,):
        if check_regular(part).suffix == ".db3":
            _check_tables(part)

    notes: dict[str, None] = {}

    def messages(topics: Collection[str] | None) -> Messages:
        with refusing("no bag of ROS, or a damaged one"):
            types = get_typestore(Stores.LATEST)  # of bags that have none
            types.register(get_types_from_msg(POSE, "turtlesim/msg/Pose"))
            with AnyReader([path], default_typestore=types) as bag:
                wanted = [c for c in bag.connections if topics is None or c.topic in topics]
                publishers = Counter(connection.topic for connection in wanted)
                for topic in (topic for topic, count in publishers.items() if count > 1):
                    notes[f"{topic}: {publishers[topic]} publishers, read as one"] = None
                for connection, t, data in bag.messages(wanted) if wanted else ():
                    try:
                        content = bag.deserialize(data, connection.msgtype)
                    except KeyError as error:
                        notes[f"{connection.topic}: its type is not known: {error.args[0]}"] = None
                        content = {}
                    yield connection.topic, t / 1e9, content

    return replace(_source(path, messages), notes=tuple(printable(note, 200) for note in notes))


def _check_tables(file: Path) -> None:
    """Refuse views in a database: what they hold is computed, and need not end."""
    address = f"{file.resolve().as_uri()}?immutable=1"
    with (
        refusing("no bag of ROS, or a damaged one"),
        closing(sqlite3.connect(address, uri=True)) as base,
    ):
        view = base.execute("SELECT name FROM sqlite_master WHERE type = 'view'").fetchone()
    if view:
        raise ConfigurationError(f"view {printable(str(view[0]))}: expected only tables")


def _source(path: Path, messages: Any, looked_at: int = 20) -> Source:
    """Return a source of messages: a first pass finds the fields, in some of each topic."""
    fields: dict[str, tuple[str, Field]] = {}
    counts: Counter[str] = Counter()
    for topic, _, content in messages(None):
        counts[topic] += 1
        if counts[topic] <= looked_at:
            named = islice(fields_of(content), WIDEST)
            fields |= {f"{topic}{name}": (topic, way) for name, way in named}
        if len(fields) > NAMES:
            break

    def read(wanted: Sequence[str]) -> dict[str, pd.Series]:
        chosen = {name: fields[name] for name in wanted}
        return series_of(messages({topic for topic, _ in chosen.values()}), chosen)

    return Source(path, list(fields), read, topics=counts)


def _decoder(schema: Any, encoding: str) -> Any:
    """Return what makes an object of a message's bytes, or None if nothing here can."""
    if encoding == "json":
        return json.loads
    if encoding not in ("cdr", "ros1") or schema is None:
        return None
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    text, name = schema.data.decode(), schema.name
    if "/msg/" not in name:  # as ROS 1 has it
        name = "/msg/".join(name.split("/", 1))
    if schema.encoding == "ros2idl":
        store.register(get_types_from_idl(text))
    else:
        store.register(get_types_from_msg(text, name))
    read = store.deserialize_cdr if encoding == "cdr" else store.deserialize_ros1
    return lambda data: read(data, name)


def open_ulog(path: Path) -> Source:
    """Return the fields of a ULog: ``TOPIC.FIELD``, or ``TOPIC[1].FIELD`` of a second instance."""
    needs("a ULog", "pyulog", "logs")
    from pyulog import ULog

    class Subscription(ULog._MessageAddLogged):
        """The fields of a topic, whose formats may hold each other in any number."""

        left = NAMES

        def _parse_nested_type(self, prefix: str, name: str, formats: Any) -> None:
            width = sum(max(size, 1) for _, size, _ in formats[name].fields)
            Subscription.left -= width
            if Subscription.left < 0:  # no ValueError, which pyulog passes over
                raise RuntimeError(f"topics of more than {NAMES:,} fields; expected fewer")
            super()._parse_nested_type(prefix, name, formats)

    class Bounded(ULog):
        _MessageAddLogged = Subscription

    with (
        refusing("no ULog, or a damaged one"),
        path.open("rb") as file,
        redirect_stdout(io.StringIO()),
    ):
        topics = {
            f"{data.name}[{data.multi_id}]" if data.multi_id else data.name: data.data
            for data in Bounded(file).data_list
        }
    fields = {
        f"{topic}.{field}": (topic, field)
        for topic, data in topics.items()
        for field in data
        if field != TIME and TIME in data
    }

    def read(wanted: Sequence[str]) -> dict[str, pd.Series]:
        series = {}
        for name in wanted:
            topic, field = fields[name]
            t = topics[topic][TIME].astype(float) / 1e6
            series[name] = sorted_series(topics[topic][field].astype(float), t)
        return series

    counts = {topic: len(data[TIME]) for topic, data in topics.items() if TIME in data}
    return Source(path, list(fields), read, topics=counts)
