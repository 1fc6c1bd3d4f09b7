"""Overrides that only some of the methods of a comparison have."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

PARTS = ("dynamics", "updater", "transform", "flow")
OPTIONAL = "++"  # how Hydra is told to take a setting whether it is there or not
_SETTING = re.compile(rf"(?:{'|'.join(PARTS)})\.[^=]+=")


def relaxed(arguments: Sequence[str]) -> list[str]:
    """Let Hydra accept settings of parts before it is known which methods have them.

    A comparison's configuration is composed once for the command line as a whole and then for
    each method; the first must not fail because of what only some methods have. A single
    method's arguments stay as they are.

    >>> relaxed(["study=ugv", "dynamics.propagation=member", "seeds=2"])
    ['study=ugv', '++dynamics.propagation=member', 'seeds=2']
    >>> relaxed(["method=physics", "dynamics.propagation=member"])
    ['method=physics', 'dynamics.propagation=member']
    """
    keys = {text.partition("=")[0] for text in arguments}
    if "method" in keys or not (keys & {"study", "compare"} or keys.isdisjoint(PARTS)):
        return list(arguments)
    return [OPTIONAL + text if _SETTING.match(text) else text for text in arguments]


def optional(overrides: Sequence[str]) -> dict[str, str]:
    """Return the overrides that need not fit every method, by key.

    >>> optional(["seeds=2", "++dynamics.propagation=member"])
    {'dynamics.propagation': '++dynamics.propagation=member'}
    """
    bare = {text: text.removeprefix(OPTIONAL) for text in overrides if text.startswith(OPTIONAL)}
    return {
        setting.partition("=")[0]: text for text, setting in bare.items() if _SETTING.match(setting)
    }


def has(settings: Mapping[str, Any], key: str) -> bool:
    """Is there a setting of this name?

    >>> has({"flow": {"checkpoint": None}}, "flow.checkpoint"), has({"flow": {}}, "flow.gate")
    (True, False)
    """
    place: Any = settings
    for name in key.split("."):
        if not isinstance(place, Mapping) or name not in place:
            return False
        place = place[name]
    return True
