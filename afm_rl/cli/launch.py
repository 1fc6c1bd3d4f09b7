"""From a composed configuration to a folder of results."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import torch
from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, ListConfig, OmegaConf

from afm_rl.artefacts import write_whole
from afm_rl.errors import ConfigurationError, check_count, check_flag
from afm_rl.missions import build, prepare, run
from afm_rl.report import print_summary, write_run

PARTS = ("dynamics", "updater", "transform", "flow")
SWITCHES = ("overwrite", "progress", "figures", "tensorboard")


def launch(cfg: DictConfig) -> None:
    """Run the missions of one method, or of several to compare, and write the results.

    Everything is built and checked before anything is trained.
    """
    torch.set_num_threads(check_count("threads", cfg.threads))
    for name in SWITCHES:
        check_flag(name, cfg[name])
    if not isinstance(cfg.cache, str):
        raise ConfigurationError(f"cache={cfg.cache!r}: expected a folder")
    job = HydraConfig.get()
    folder = Path(job.runtime.output_dir)
    if (folder / "missions.csv").exists() and not cfg.overwrite:
        raise ConfigurationError(
            f"hydra.run.dir={folder}: holds results; choose another folder, or overwrite=true"
        )
    methods = _methods(cfg, list(job.overrides.task), job.runtime.choices.get("method"))
    agents = [build(method) for method in methods]
    for method in methods:
        name = "config.yaml" if len(methods) == 1 else f"config/{method.label}.yaml"
        write_whole(folder / name, OmegaConf.to_yaml(method, resolve=True).encode())
    for agent in agents:
        prepare(agent, cfg.cache, progress=cfg.progress)
    results = [run(agent, progress=cfg.progress) for agent in agents]
    missions, steps = _joined(results)
    tracks = {track.name: track for agent in agents for track in agent.base_env.tracks}
    shown = {"figures": cfg.figures, "tensorboard": cfg.tensorboard}
    write_run(folder, missions, steps, list(tracks.values()), **shown)
    print_summary(missions)
    print(f"Results: {folder}")


def _methods(cfg: DictConfig, overrides: Sequence[str], method: str | None) -> list[DictConfig]:
    """Return one configuration per method, each with its label; none compares any more."""
    compare = cfg.compare
    if compare is not None:
        names = list(compare) if isinstance(compare, ListConfig) else [None]
        if not all(isinstance(n, str) for n in names) or len(set(names)) < len(names):
            raise ConfigurationError(f"compare={compare}: expected a list of distinct methods")
    given = {text.split("=")[0] for text in overrides}
    by_hand = "compare" not in given and not given.isdisjoint(PARTS)
    if method is not None or by_hand or not cfg.compare:
        chosen = [(method, cfg)]
    else:
        chosen = [(name, compose("config", [*overrides, f"method={name}"])) for name in names]
    for name, each in chosen:
        each.compare = []
        each.label = each.label if len(chosen) == 1 and each.label else _label(name, overrides)
    return [each for _, each in chosen]


def _label(method: str | None, overrides: Sequence[str]) -> str:
    """Name a method after its preset and the parts that were chosen by hand.

    >>> _label("online_pe", ["seeds=2", "flow=context", "transform=afm"])
    'online_pe+flow=context+transform=afm'
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
