"""Which folder each job of a sweep gets, so that a job is found again by its settings."""

from __future__ import annotations

import hashlib
import itertools
import json
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import safe_dump, safe_load

from afm_rl._version import __version__
from afm_rl.artefacts import write_whole
from afm_rl.cli.launchers.job import Job
from afm_rl.cli.overrides import PARTS
from afm_rl.missions.settings import influential

ASKED = "job.yaml"
ELSEWHERE = ("hydra.mode=", "hydra.run", "hydra.sweep", "hydra.launcher", "hydra/")
"""Overrides of Hydra's own that are of the sweep, not of its jobs."""


def plan(sweep: Path, configs: Sequence[DictConfig]) -> list[Job]:
    """Return the jobs of a sweep, each with a folder: the one it has had before, or a new one.

    Folders are numbered. ``job.yaml`` in each says what was asked, by overrides and by a hash of
    the settings that they lead to; other settings make another job, with a folder of its own.

    Args:
        sweep: folder of the sweep; made if it is not there.
        configs: one per job, with Hydra's own part.
    """
    known = {}
    for path in sorted(sweep.glob(f"*/{ASKED}"), reverse=True):
        known[safe_load(path.read_text())["settings"]] = path.parent
    asked = [_task(cfg) for cfg in configs]
    common = set.intersection(*map(set, asked)) if len(asked) > 1 else set()
    jobs = []
    for cfg, overrides in zip(configs, asked, strict=True):
        digest = digest_of_settings(cfg, overrides)
        if digest not in known:
            known[digest] = _new_folder(sweep)
            told = {
                "command": shlex.join(["afm-rl", *overrides]),
                "overrides": overrides,
                "settings": digest,
            }
            write_whole(known[digest] / ASKED, safe_dump(told, sort_keys=False).encode())
        name = " ".join(text for text in overrides if text not in common)
        arguments = (*_options(cfg), *overrides, *_own(cfg.hydra.overrides.hydra))
        jobs.append(Job(known[digest], digest, name, arguments, Path.cwd()))
    return jobs


def digest_of_settings(cfg: DictConfig, overrides: Iterable[str]) -> str:
    """Return a hash of what a job's results depend on.

    Args:
        cfg: the configuration, whether or not everything in it can be resolved.
        overrides: what the user chose; the choice of a part stands in the labels of the methods.
    """
    bare = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"])
    settings: Any
    try:
        settings = OmegaConf.to_container(bare, resolve=True)
    except OmegaConfBaseException:  # the job will say what is wrong
        settings = OmegaConf.to_container(bare, resolve=False)
    what = influential(settings) | {
        "compare": settings.get("compare"),
        "label": settings.get("label"),
        "study": settings.get("study") is not None,
        "parts": [text for text in overrides if text.split("=")[0] in (*PARTS, "method")],
        "version": __version__,
    }
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()


def _task(cfg: DictConfig) -> list[str]:
    return [text for text in cfg.hydra.overrides.task if not text.startswith("launcher=")]


def _own(overrides: Iterable[str]) -> list[str]:
    return [text for text in overrides if not text.lstrip("+~").startswith(ELSEWHERE)]


def _options(cfg: DictConfig) -> list[str]:
    """Return options that say which configuration is meant, if it is not the usual one."""
    options = [f"--config-name={cfg.hydra.job.config_name}"]
    for source in cfg.hydra.runtime.config_sources:
        path = source.path if source.schema == "file" else f"{source.schema}://{source.path}"
        if source.provider == "main":
            options.append(f"--config-path={path}")
        elif source.provider == "command-line":
            options.append(f"--config-dir={path}")
    return options


def _new_folder(sweep: Path) -> Path:
    """Make the folder with the first number that is free, also beside another sweep's process."""
    numbers = itertools.count()
    while True:
        folder = sweep / str(next(numbers))
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            continue
