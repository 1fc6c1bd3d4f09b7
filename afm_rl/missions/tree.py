"""Nested dictionaries as two flat ones: tensors for one kind of file, the rest for another."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from torch import Tensor

Tree = Mapping[Any, Any]


def flatten(tree: Tree) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return the tensors and the other values, each by its path.

    A path is a JSON list, so that keys may hold any character and numbers stay numbers.

    >>> import torch
    >>> flatten({"a": {0: torch.ones(2)}, "b": 3})
    ({'["a", 0]': tensor([1., 1.])}, {'["b"]': 3})
    """
    tensors: dict[str, Tensor] = {}
    plain: dict[str, Any] = {}
    for path, value in _leaves(tree, ()):
        if isinstance(value, Tensor):
            tensors[json.dumps(path)] = value
        else:
            plain[json.dumps(path)] = value
    return tensors, plain


def unflatten(tensors: Mapping[str, Tensor], plain: Mapping[str, Any]) -> dict[Any, Any]:
    """Undo :func:`flatten`.

    >>> unflatten({}, {'["a", 0]': 1, '["b"]': {}})
    {'a': {0: 1}, 'b': {}}
    """
    tree: dict[Any, Any] = {}
    for name, value in (*tensors.items(), *plain.items()):
        *path, last = json.loads(name)
        place = tree
        for key in path:
            place = place.setdefault(key, {})
        place[last] = value
    return tree


def _leaves(value: Any, path: tuple[Any, ...]) -> Iterator[tuple[tuple[Any, ...], Any]]:
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from _leaves(inner, (*path, key))
    else:
        yield path, dict(value) if isinstance(value, Mapping) else value
