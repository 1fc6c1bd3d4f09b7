"""The methods that a command asks for, each with a configuration of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

from hydra import compose
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict

from afm_rl.cli.error_messages import places_of
from afm_rl.cli.overrides import OPTIONAL, PARTS, optional
from afm_rl.errors import ConfigurationError
from afm_rl.missions.selection import select_seeds


def jobs_of(cfg: DictConfig, hydra: DictConfig, swept: Sequence[str] = ()) -> dict[str, DictConfig]:
    """Return the configuration of each job that a command asks for, by name.

    A job is one method; in a study, one method with one seed.
    """
    # What tables show themselves: methods need not be named after it.
    in_tables = ("method", "label", "compare", "study", "seeds", "tracks", "regimes")
    methods = _methods(cfg, hydra)
    loose = optional(swept)
    swept = [text.removeprefix(OPTIONAL) for text in swept]
    keys = {text: text.lstrip("+~").split("=")[0] for text in swept}
    jobs: dict[str, DictConfig] = {}
    for method in methods:
        parts = method.label.split("+")
        parts += [text for text, key in keys.items() if key in loose and not _has(method, key)]
        extra = [t for t, key in keys.items() if key not in in_tables and t not in parts]
        method.label = "+".join([method.label, *extra])
        shown = [text for text, key in keys.items() if key in in_tables]
        labelled = ("compare", "label") if cfg.label else ("method", "compare", "label")
        shown = [text for text in shown if keys[text] not in labelled]
        name = "+".join([method.label, *shown])
        if cfg.get("study") is None:
            jobs[name] = method
            continue
        settings: Any = OmegaConf.to_container(method, resolve=True)
        for seed in select_seeds(settings["seeds"]):
            one = OmegaConf.merge(method, {"seeds": [seed]})
            jobs[f"{name}+seed={seed}"] = cast(DictConfig, one)
    return jobs


def _methods(cfg: DictConfig, hydra: DictConfig) -> list[DictConfig]:
    """Return one configuration per method, each with its label; none compares any more."""
    overrides, method = list(hydra.overrides.task), hydra.runtime.choices.get("method")
    compare = cfg.compare
    if compare is not None:
        names = list(compare) if isinstance(compare, ListConfig) else [None]
        if not all(isinstance(n, str) for n in names) or len(set(names)) < len(names):
            raise ConfigurationError(f"compare={compare}: expected a list of distinct methods")
    given = {text.split("=")[0] for text in overrides}
    one = given.isdisjoint({"compare", "study"})
    by_hand = one and not given.isdisjoint(PARTS)
    alone = (method is not None and (one or "method" in given)) or by_hand or not cfg.compare
    root = hydra.job.config_name
    chosen: list[tuple[str | None, DictConfig]] = [(method, cfg)]
    if not alone:
        compared = {name: _fitted([*overrides, f"method={name}"], root) for name in compare}
        check_had(overrides, compared)
        chosen = list(compared.items())
    elif hydra.mode == RunMode.MULTIRUN and optional(overrides):
        chosen = [(method, _fitted(overrides, root))]
    for name, each in chosen:
        for key in optional(overrides):
            if not _has(each, key):
                print(
                    f"{_label(name, overrides)}: has no {key}, so this setting does not change it"
                )
    own = []
    for name, each in chosen:
        each = OmegaConf.masked_copy(each, [str(k) for k in each if k not in ("hydra", "study")])
        label = each.label if len(chosen) == 1 and each.label else _label(name, overrides)
        if not isinstance(label, str):
            raise ConfigurationError(f"label={label!r}: expected a text")
        with open_dict(each):
            each.compare, each.label = [], label
        own.append(each)
    return own


def _fitted(overrides: Sequence[str], root: str) -> DictConfig:
    """Compose a method with those settings of its parts that it has."""
    loose = optional(overrides)
    bare = compose(root, [text for text in overrides if text not in loose.values()])
    lacking = [text for key, text in loose.items() if not _has(bare, key)]
    return compose(root, [text for text in overrides if text not in lacking]) if loose else bare


def check_had(overrides: Sequence[str], methods: Mapping[str, DictConfig]) -> None:
    """Check that a setting which not every method needs to have is one of some method.

    Raises:
        ConfigurationError: naming the first setting that none has.
    """
    for key, text in optional(overrides).items():
        if methods and not any(_has(each, key) for each in methods.values()):
            raise ConfigurationError(f"{text.lstrip('+')}: none of {', '.join(methods)} has {key}")


def _has(cfg: DictConfig, key: str) -> bool:
    return key in places_of(OmegaConf.to_container(cfg, resolve=False))


def _label(method: str | None, overrides: Sequence[str]) -> str:
    """Name a method after its preset and the parts that were chosen by hand.

    >>> _label("online_pe", ["seeds=2", "updater=rls", "corrector=afm"])
    'online_pe+updater=rls+corrector=afm'
    """
    parts = [text for text in overrides if text.split("=")[0] in PARTS]
    return "+".join([*([method] if method else []), *parts]) or "physics"
