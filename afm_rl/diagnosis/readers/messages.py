"""Messages as series of numbers: which fields they have, and what these hold."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from afm_rl.diagnosis.readers.source import Series

Field = tuple[str | int, ...]
"""The way to a number: attributes, keys, places in arrays."""


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


def value_at(message: Any, way: Field) -> float:
    """Return the number at a place of a message, NaN where there is none.

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
        return float("nan")


def series_of(
    messages: Iterable[tuple[str, float, Any]], wanted: Mapping[str, tuple[str, Field]]
) -> dict[str, Series]:
    """Return the series of fields.

    Args:
        messages: topic, time (s) and content of each.
        wanted: topic and way of each name.
    """
    by_topic: dict[str, list[str]] = {}
    for name, (topic, _) in wanted.items():
        by_topic.setdefault(topic, []).append(name)
    times: dict[str, list[float]] = {topic: [] for topic in by_topic}
    values: dict[str, list[float]] = {name: [] for name in wanted}
    for topic, t, content in messages:
        times[topic].append(t)
        for name in by_topic[topic]:
            values[name].append(value_at(content, wanted[name][1]))
    return {
        name: sorted_series(np.array(values[name]), np.array(times[topic]))
        for name, (topic, _) in wanted.items()
    }


def sorted_series(values: np.ndarray, t: np.ndarray) -> Series:
    """Return values in the order of their times, the last one of each time.

    >>> sorted_series(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.2, 0.0]))
    Series(values=array([3., 2.]), t=array([0. , 0.2]), row=None)
    """
    order = np.argsort(t, kind="stable")
    t = t[order]
    last = np.append(t[1:] > t[:-1], True)[: len(t)]
    return Series(values[order][last], t[last])


def _parts(message: Any) -> Mapping[str, Any]:
    if isinstance(message, Mapping):
        return {str(key): value for key, value in message.items()}
    names: Sequence[str] = getattr(message, "__dataclass_fields__", ())
    return {name: getattr(message, name) for name in names if not name.startswith("__")}


def _get(message: Any, key: Any) -> Any:
    return message[key] if isinstance(message, Mapping) else getattr(message, key)
