"""Arguments of a command before Hydra reads them: what only some methods have, what is trusted."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser

from afm_rl.cli.sources import check_links, checked_files
from afm_rl.trust import check_trust, trusting

PARTS = ("dynamics", "updater", "corrector")
OPTIONAL = "++"  # makes Hydra accept a setting whether it exists or not
_SETTING = re.compile(rf"(?:{'|'.join(PARTS)})\.[^=]+=")


def relaxed(arguments: Sequence[str]) -> list[str]:
    """Let Hydra accept settings of parts before it is known which methods have them.

    A comparison's configuration is composed once for the command line as a whole and then for
    each method; the first must not fail because of what only some methods have, nor must a job of a
    sweep over methods. A single method's arguments stay as they are.

    >>> relaxed(["study=ugv", "dynamics.propagation=sample", "seeds=2"])
    ['study=ugv', '++dynamics.propagation=sample', 'seeds=2']
    >>> relaxed(["-m", "method=physics,frozen_pe", "dynamics.propagation=sample"])
    ['-m', 'method=physics,frozen_pe', '++dynamics.propagation=sample']
    >>> relaxed(["method=physics", "dynamics.propagation=sample"])
    ['method=physics', 'dynamics.propagation=sample']
    """
    keys = {text.partition("=")[0] for text in arguments}
    several = keys & {"study", "compare"} or keys.isdisjoint({"agent", *PARTS})
    if not keys & {"-m", "--multirun"} and ("method" in keys or not several):
        return list(arguments)
    return [OPTIONAL + text if _SETTING.match(text) else text for text in arguments]


def with_sweep_folder(arguments: Sequence[str]) -> list[str]:
    """Let the same sweep go to the same folder, so that it can be returned to.

    The folder is named after what is swept, and a hash of all that is asked.

    >>> with_sweep_folder(["-m", "method=physics,oracle", "hydra/launcher=local"])[-1]
    'hydra.sweep.dir=multirun/method-d7b447'
    >>> with_sweep_folder(["method=physics"])
    ['method=physics']
    """
    if not {"-m", "--multirun"} & set(arguments):
        return list(arguments)
    given = [text.partition("=") for text in arguments]
    if any(key == "hydra.sweep.dir" for key, *_ in given):
        return list(arguments)
    own = [parts for parts in given if not parts[0].startswith(("hydra.", "hydra/"))]
    shown = ("progress", "figures", "video", "tensorboard", "tensorboard_every", "diagnosis")
    done = ("overwrite", "cache", "threads", "-m", "--multirun")
    rest = [parts for parts in own if parts[0] not in (*shown, *done)]  # what makes another sweep
    settings = ["".join(parts).removeprefix(OPTIONAL) for parts in rest]
    bare = [(key, re.sub(r"\[.*]|\{.*}", "", value)) for key, _, value in own]  # lists do not sweep
    swept = [key.strip("+~") for key, value in bare if re.search(r"[,(]", value)]
    name = "-".join([*swept, hashlib.sha256("\0".join(sorted(settings)).encode()).hexdigest()[:6]])
    folder = f"hydra.sweep.dir=multirun/{re.sub(r'[^-.0-9A-Z_a-z]', '_', name[-60:])}"
    beside = max(
        (n for n, text in enumerate(arguments) if text[:1] != "-" and "=" in text), default=-1
    )
    return [*arguments[: beside + 1], folder, *arguments[beside + 1 :]]  # Hydra wants them together


def optional(overrides: Sequence[str]) -> dict[str, str]:
    """Return the overrides that need not fit every method, by key.

    >>> optional(["seeds=2", "++dynamics.propagation=sample"])
    {'dynamics.propagation': '++dynamics.propagation=sample'}
    """
    bare = {text: text.removeprefix(OPTIONAL) for text in overrides if text.startswith(OPTIONAL)}
    return {
        setting.partition("=")[0]: text for text, setting in bare.items() if _SETTING.match(setting)
    }


def values_of(key: str, arguments: Sequence[str]) -> list[Any]:
    """Return what a command line itself gives a setting.

    >>> values_of("trust", ["method=physics", "trust=[mine, my.models]"])
    [['mine', 'my.models']]
    """
    texts = [text for text in arguments if re.match(rf"\+{{0,2}}{key}=", text)]
    return [each.value() for each in OverridesParser.create().parse_overrides(texts)]


def named_packages(arguments: Sequence[str]) -> list[str]:
    """Return the packages that a command trusts: those of its line, and of ``AFM_RL_TRUST``.

    Raises:
        ConfigurationError: for what is no name.
    """
    named = os.environ.get("AFM_RL_TRUST", "").split(",")
    given = [name for names in values_of("trust", arguments) for name in check_trust(names)]
    return [*filter(None, named), *given]


@contextmanager
def checked(arguments: Sequence[str]) -> Iterator[list[str]]:
    """Let Hydra compose what a command asks for of files that are checked as they are read.

    Trusted is what the command line names, and ``AFM_RL_TRUST`` as it is now.

    Yields:
        The packages that are trusted.
    """
    names = named_packages(arguments)
    check_links(map(str, values_of(r"hydra\.(run|sweep)\.dir", arguments)))
    with trusting(names), checked_files():
        yield names
