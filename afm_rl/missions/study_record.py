"""What a study was asked to do, in its folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf
from yaml import YAMLError, safe_dump, safe_load

from afm_rl._version import __version__
from afm_rl.artefacts import write_whole
from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.missions.selection import select_seeds
from afm_rl.missions.settings import differences, influential
from afm_rl.missions.shard import MISSIONS, Shard

RECORD = "study.yaml"


class Asked(NamedTuple):
    """What a study is asked to do."""

    seeds: list[int]
    methods: dict[str, dict[str, Any]]
    """The settings that results depend on, by method, but for the seeds."""

    @property
    def shards(self) -> list[Shard]:
        """All of them: every method with the first seed, then with the next."""
        return [Shard(method, seed) for seed in self.seeds for method in self.methods]


def asked(methods: Sequence[DictConfig]) -> Asked:
    """Return what configurations, alike but for the method, ask for.

    Raises:
        ConfigurationError: for a label that cannot name a folder.
    """
    found: dict[str, dict[str, Any]] = {}
    for cfg in methods:
        if not isinstance(cfg.label, str) or cfg.label.strip(".") == "" or "/" in cfg.label:
            raise ConfigurationError(f"label={cfg.label!r}: expected a text without /")
        settings: Any = OmegaConf.to_container(cfg, resolve=True)
        seeds = select_seeds(settings.pop("seeds"))
        found[cfg.label] = influential(settings)
    return Asked(seeds, found)


def record(study: Path, methods: Sequence[DictConfig]) -> Asked:
    """Write down what is asked; what was asked before stays part of the study.

    Args:
        study: folder of the study, locked.
        methods: one configuration per method, with its label.

    Returns:
        All that has been asked of this study, seeds in order.

    Raises:
        ConfigurationError: if the folder holds something else, or a study with other settings.
        ArtefactError: if what is written there cannot be read.
    """
    new = asked(methods)
    path = study / RECORD
    if path.exists():
        new = _extended(study, _read(path), new)
    elif (study / MISSIONS).exists():
        raise ConfigurationError(
            f"hydra.run.dir={study}: holds results of something else; choose another folder"
        )
    whole = {"version": __version__, "seeds": new.seeds, "methods": new.methods}
    write_whole(path, safe_dump(whole, sort_keys=False).encode())
    for cfg in methods:
        settings = OmegaConf.merge(cfg, {"seeds": new.seeds})
        text = OmegaConf.to_yaml(settings, resolve=True)
        write_whole(study / "config" / f"{cfg.label}.yaml", text.encode())
    return new


def _read(path: Path) -> Mapping[str, Any]:
    try:
        found = safe_load(path.read_text())
        if {"version", "seeds", "methods"} <= set(found):
            return found
    except (YAMLError, TypeError, UnicodeDecodeError):
        pass
    raise ArtefactError(f"{path}: damaged; restore it, or choose another folder")


def _extended(study: Path, old: Mapping[str, Any], new: Asked) -> Asked:
    apart = differences({"version": old["version"]}, {"version": __version__})
    for method in old["methods"].keys() & new.methods.keys():
        apart += differences(old["methods"][method], new.methods[method])
    if apart:
        raise ConfigurationError(
            f"hydra.run.dir={study}: holds a study with other settings "
            f"({'; '.join(sorted(set(apart)))}); choose another folder"
        )
    methods = {**old["methods"], **new.methods}
    if old["methods"].keys() <= new.methods.keys():
        methods = new.methods
    return Asked(sorted({*old["seeds"], *new.seeds}), methods)
