"""TensorDict keys, as written in Python or in YAML."""

from __future__ import annotations

from collections.abc import Iterable

from tensordict import NestedKey

from afm_rl.errors import ConfigurationError


def as_key(key: str | Iterable[str]) -> NestedKey:
    """Return ``key`` as tensordict wants it: a string, or a tuple of strings.

    YAML has no tuples, so nested keys arrive as lists.

    Raises:
        ConfigurationError: if it is neither.

    >>> as_key(["afm", "executed_action"])
    ('afm', 'executed_action')
    >>> as_key("action"), as_key(["action"])
    ('action', 'action')
    """
    if isinstance(key, str):
        return key
    parts = tuple(key) if isinstance(key, Iterable) else ()
    if not parts or not all(isinstance(part, str) for part in parts):
        raise ConfigurationError(f"key {key!r}: expected a text, or a list of texts")
    return parts[0] if len(parts) == 1 else parts


def as_keys(keys: Iterable[str | Iterable[str]]) -> list[NestedKey]:
    """Apply :func:`as_key` to each of ``keys``."""
    return [as_key(key) for key in keys]
