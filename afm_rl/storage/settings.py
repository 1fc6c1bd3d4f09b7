"""Which settings two runs share, and which of them have a say in the results."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

WITHOUT_INFLUENCE = (
    *(
        "progress",
        "figures",
        "video",
        "tensorboard",
        "overwrite",
        "cache",
        "threads",
        "device",
        "compile",
    ),
    *("compare", "study", "label", "trust", "checkpoints"),
)
"""Settings that change how a run is done, shown or called, but not its results."""


def influential(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that results depend on, as they come back from JSON or YAML.

    >>> influential({"budget": 5, "progress": True})
    {'budget': 5}
    """
    kept = {name: value for name, value in settings.items() if name not in WITHOUT_INFLUENCE}
    return json.loads(json.dumps(_without(kept, ("cache", "compile"))))


def _without(value: Any, names: tuple[str, ...]) -> Any:
    """Leave out entries of nested mappings."""
    if not isinstance(value, Mapping):
        return value
    return {key: _without(part, names) for key, part in value.items() if key not in names}


def differences(old: Any, new: Any) -> list[str]:
    """Name what differs between two nested mappings, one line for each value.

    >>> differences({"a": {"b": 1, "c": 2}}, {"a": {"b": 3}, "d": None})
    ['a.b: 1 -> 3', 'a.c: 2 -> nothing', 'd: nothing -> None']
    """
    return list(_differences(old, new, ""))


def _differences(old: Any, new: Any, key: str) -> Iterator[str]:
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for name in dict.fromkeys([*old, *new]):
            was, will = (side.get(name, _Nothing()) for side in (old, new))
            yield from _differences(was, will, f"{key}.{name}" if key else str(name))
    elif old != new:
        yield f"{key}: {old} -> {new}"


class _Nothing:
    """Stands for a value that is not there."""

    def __str__(self) -> str:
        return "nothing"
