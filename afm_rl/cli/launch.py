"""From a composed configuration to a folder of results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, ListConfig, OmegaConf

from afm_rl.artefacts import write_whole
from afm_rl.cli.overrides import PARTS, has, optional
from afm_rl.errors import ConfigurationError, check_count, check_flag
from afm_rl.missions import build, prepare, run
from afm_rl.report import check_video, print_summary, write_films, write_run

SWITCHES = ("overwrite", "progress", "figures", "tensorboard")


def launch(cfg: DictConfig) -> None:
    """Run the missions of one method, of several to compare, or a study; write the results.

    Everything is built and checked before anything is trained.
    """
    torch.set_num_threads(check_count("threads", cfg.threads))
    for name in SWITCHES:
        check_flag(name, cfg[name])
    film = check_video(cfg.video)
    if not isinstance(cfg.cache, str):
        raise ConfigurationError(f"cache={cfg.cache!r}: expected a folder")
    job = HydraConfig.get()
    folder = Path(job.runtime.output_dir)
    study = cfg.get("study")
    if (folder / "missions.csv").exists() and not cfg.overwrite and study is None:
        raise ConfigurationError(
            f"hydra.run.dir={folder}: holds results; choose another folder, or overwrite=true"
        )
    methods = _methods(cfg, list(job.overrides.task), job.runtime.choices.get("method"))
    if study is not None:
        if film is not None:
            raise ConfigurationError(
                f"video={cfg.video}: a study makes no films; use afm-rl-report {folder} --video gif"
            )
        from afm_rl.cli.study import launch_study  # file locks: not on every system

        launch_study(study, methods, folder, cfg.progress, cfg.figures)
        return
    agents = [build(method) for method in methods]
    for method in methods:
        name = "config.yaml" if len(methods) == 1 else f"config/{method.label}.yaml"
        write_whole(folder / name, OmegaConf.to_yaml(method, resolve=True).encode())
    for agent in agents:
        prepare(agent, cfg.cache, progress=cfg.progress)
    results = [run(agent, progress=cfg.progress) for agent in agents]
    missions, steps = _joined(results)
    roads = [getattr(agent.base_env, "tracks", ()) for agent in agents]  # flights have none
    tracks = {track.name: track for some in roads for track in some}
    shown = {"figures": cfg.figures, "tensorboard": cfg.tensorboard}
    write_run(folder, missions, steps, results[0].measures, list(tracks.values()), **shown)
    if film is not None:
        write_films(folder / "video", missions, steps, list(tracks.values()), film)
    print_summary(missions, results[0].measures)
    print(f"Results: {folder}")


def _methods(cfg: DictConfig, overrides: Sequence[str], method: str | None) -> list[DictConfig]:
    """Return one configuration per method, each with its label; none compares any more."""
    compare = cfg.compare
    if compare is not None:
        names = list(compare) if isinstance(compare, ListConfig) else [None]
        if not all(isinstance(n, str) for n in names) or len(set(names)) < len(names):
            raise ConfigurationError(f"compare={compare}: expected a list of distinct methods")
    given = {text.split("=")[0] for text in overrides}
    by_hand = given.isdisjoint({"compare", "study"}) and not given.isdisjoint(PARTS)
    if method is not None or by_hand or not cfg.compare:
        chosen = [(method, cfg)]
    else:
        chosen = [*_compared(list(compare), overrides)]
    for name, each in chosen:
        each.compare = []
        OmegaConf.set_struct(each, False)
        each.pop("study", None)
        each.label = each.label if len(chosen) == 1 and each.label else _label(name, overrides)
    return [each for _, each in chosen]


def _compared(names: Sequence[str], overrides: Sequence[str]) -> list[tuple[str, DictConfig]]:
    """Compose each method with those settings of its parts that it has.

    Raises:
        ConfigurationError: for a setting that none of them has.
    """
    some = optional(overrides)
    common = [text for text in overrides if text not in some.values()]
    bare = {name: compose("config", [*common, f"method={name}"]) for name in names}
    if not some:
        return list(bare.items())
    plain: dict[str, Any] = {
        name: OmegaConf.to_container(cfg, resolve=False) for name, cfg in bare.items()
    }
    for key, text in some.items():
        without = [name for name in names if not has(plain[name], key)]
        if len(without) == len(names):
            raise ConfigurationError(f"{text.lstrip('+')}: none of {', '.join(names)} has {key}")
        for name in without:
            print(f"{name}: has no {key}, so it stays as it is")
    return [
        (name, compose("config", [*common, *_fitting(some, plain[name]), f"method={name}"]))
        for name in names
    ]


def _fitting(some: Mapping[str, str], settings: Mapping[str, Any]) -> list[str]:
    """Return the overrides of settings that there are."""
    return [text for key, text in some.items() if has(settings, key)]


def _label(method: str | None, overrides: Sequence[str]) -> str:
    """Name a method after its preset and the parts that were chosen by hand.

    >>> _label("online_pe", ["seeds=2", "updater=rls", "corrector=afm"])
    'online_pe+updater=rls+corrector=afm'
    """
    parts = [text for text in overrides if text.split("=")[0] in PARTS]
    return "+".join([*([method] if method else []), *parts]) or "physics"


def _joined(results) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Put the tables of several methods together; missions are numbered through."""
    missions, steps, count = [], [], 0
    for result in results:
        missions.append(result.missions.assign(mission=result.missions["mission"] + count))
        steps.append(result.steps.assign(mission=result.steps["mission"] + count))
        count += len(result.missions)
    return pd.concat(missions, ignore_index=True), pd.concat(steps, ignore_index=True)
