"""Overrides that only some of the methods of a comparison have."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from typing import Any

PARTS = ("dynamics", "updater", "corrector")
OPTIONAL = "++"  # how Hydra is told to take a setting whether it is there or not
BESIDE = (
    *("launcher", "progress", "overwrite", "cache", "threads", "figures", "video", "tensorboard"),
    *("-m", "--multirun"),
)
"""What does not make a command another sweep."""
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


def with_sweep_folder(arguments: Sequence[str]) -> list[str]:
    """Let the same sweep go to the same folder, so that it can be returned to.

    The folder is named after what is swept, and a hash of all that is asked. ``hydra/launcher=X``
    is understood as ``launcher=X``.

    >>> with_sweep_folder(["-m", "method=physics,oracle", "launcher=basic"])[-1]
    'hydra.sweep.dir=multirun/method-d7b447'
    >>> with_sweep_folder(["method=physics"])
    ['method=physics']
    """
    if not {"-m", "--multirun"} & set(arguments):
        return list(arguments)
    given = [text.partition("=") for text in arguments]
    if all(key not in ("launcher", "~launcher") for key, *_ in given):
        arguments = [re.sub("^hydra/launcher=", "launcher=", text) for text in arguments]
    if any(key == "hydra.sweep.dir" for key, *_ in given):
        return list(arguments)
    own = [parts for parts in given if not parts[0].startswith(("hydra.", "hydra/"))]
    asked = sorted("".join(parts) for parts in own if parts[0] not in BESIDE)
    swept = [key.strip("+~") for key, _, value in own if re.search(r"[,(]", _bare(value))]
    name = "-".join([*swept, hashlib.sha256("\0".join(asked).encode()).hexdigest()[:6]])
    return [*arguments, f"hydra.sweep.dir=multirun/{re.sub(r'[^-.0-9A-Z_a-z]', '_', name[-60:])}"]


def _bare(value: str) -> str:
    """Leave out lists and mappings, whose commas do not sweep."""
    return re.sub(r"\[.*]|\{.*}", "", value)


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
    """Return whether there is a setting of this name.

    >>> has({"corrector": {"odds": 2.0}}, "corrector.odds"), has({}, "corrector.odds")
    (True, False)
    """
    place: Any = settings
    for name in key.split("."):
        if not isinstance(place, Mapping) or name not in place:
            return False
        place = place[name]
    return True
