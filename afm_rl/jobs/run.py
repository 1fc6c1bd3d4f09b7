"""A run in its folder: what it is asked, its missions, and its results, whole or not at all."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from omegaconf import DictConfig, OmegaConf

from afm_rl._version import __version__
from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.jobs.layout import is_batch, is_finished
from afm_rl.missions import Agent, Results, build, prepare, run
from afm_rl.missions.curves import EVERY, Curves
from afm_rl.storage import measures
from afm_rl.storage.files import (
    csv_text,
    file_name,
    read_settings,
    read_yaml,
    sync_folder,
    write_whole,
)
from afm_rl.storage.manifest import (
    COMPUTE,
    CONFIG,
    MANIFEST,
    MISSIONS,
    STEPS,
    UNFINISHED,
    check_manifest,
    differences,
    influential,
    read_manifest,
    write_manifest,
)

if TYPE_CHECKING:
    import pandas as pd

READY = "ready"  # the folder of new results, inside that of unfinished ones
TENSORBOARD = "tensorboard"  # the folder of curves, written while missions run
DRAWN = ("diagnosis", "figures", "video")  # folders drawn from the results
SHOWN = (*DRAWN, TENSORBOARD)


def needs_run(folder: Path, cfg: DictConfig, overwrite: bool = False) -> bool:
    """Return whether the missions of a configuration are still to be run in a folder.

    Nothing is written.

    Raises:
        ConfigurationError: if the folder holds something else.
        ArtefactError: if what it holds is damaged.
    """
    if is_batch(folder):
        raise ConfigurationError(f"hydra.run.dir={folder}: holds jobs; choose another folder")
    begun = folder / UNFINISHED / CONFIG
    if overwrite:
        return True
    if begun.exists():
        _check_same(begun, cfg, __version__)
    elif is_finished(folder):
        check_manifest(folder)
        _check_same(folder / CONFIG, cfg, read_manifest(folder)["version"])
        return False
    else:  # a run replaces all of these, so they must be those of a run
        files = (CONFIG, MISSIONS, STEPS, COMPUTE, measures.FILE, *SHOWN)
        held = [name for name in files if (folder / name).exists()]
        if held:
            raise ConfigurationError(
                f"hydra.run.dir={folder}: holds {', '.join(held)} without {MANIFEST}; choose "
                "another folder, or overwrite=true"
            )
    return True


def _check_same(path: Path, cfg: DictConfig, version: str) -> None:
    """Check that results belong to a configuration and to this version."""
    stored = influential(read_settings(path))
    wanted = influential(read_yaml(OmegaConf.to_yaml(cfg, resolve=True)))
    apart = differences({"version": version} | stored, {"version": __version__} | wanted)
    if apart:
        raise ConfigurationError(
            f"{path}: belongs to other settings ({'; '.join(apart)}); choose another folder, or "
            "overwrite=true"
        )


def begin(folder: Path, cfg: DictConfig) -> None:
    """Write down what a run is asked. Checkpoints of other settings are removed."""
    path = folder / UNFINISHED / CONFIG
    if path.exists():
        try:
            _check_same(path, cfg, __version__)
        except (ArtefactError, ConfigurationError):
            shutil.rmtree(path.parent)
    write_whole(path, OmegaConf.to_yaml(cfg, resolve=True).encode())


def finish(
    folder: Path,
    stop: Stop | None = None,
    progress: bool = False,
    echo: Callable[[str], None] = print,
    agent: Agent | None = None,
    curves: Path | None = None,
) -> None:
    """Run the missions that a folder asks for, or what is left of them, and publish the results.

    The caller holds the folder's lock.

    Args:
        folder: of the run, after :func:`begin`; a finished one is left alone.
        stop: says when to stop.
        progress: show progress.
        echo: receives lines of text.
        agent: built from the settings that the folder asks for; None: it is built here.
        curves: folder of TensorBoard's curves; None: one in ``folder``, named after the method.

    Raises:
        Stopped: if ``stop`` said so; what was done is kept.
    """
    new, stop = folder / UNFINISHED, stop or Stop()
    if not (new / CONFIG).exists():  # another process has finished it meanwhile
        return
    cfg = OmegaConf.create(read_settings(new / CONFIG))
    agent = build(cfg) if agent is None else agent
    errors = prepare(agent, cfg.cache, progress, echo)
    _forget_curves(folder)
    if not any(new.glob("checkpoint-*")):  # else these missions have curves already
        shutil.rmtree(curves or folder / TENSORBOARD, ignore_errors=True)
    place = curves or folder / TENSORBOARD / file_name(agent.label)
    written = Curves(place, cfg.get("tensorboard_every", EVERY)) if cfg.tensorboard else None
    every, keep, stop.waits = cfg.checkpoints.every, cfg.checkpoints.keep, not stop.asked
    try:
        results = run(agent, progress, new, every, keep, lambda loop: stop.asked, written)
    finally:
        stop.waits = False
        if written is not None:
            written.close()
    _publish(folder, results, errors)


def _forget_curves(folder: Path) -> None:
    """Take curves out of the manifest of older results: new ones are about to replace them."""
    if is_finished(folder):
        names = read_manifest(folder)["files"]
        write_manifest(folder, [name for name in names if Path(name).parts[0] != TENSORBOARD])


def _publish(folder: Path, results: Results, errors: Mapping[str, float] | None = None) -> None:
    """Replace what a folder holds by new results. If this is interrupted, ``finish`` does it again.

    The new files are on the disk before an old one is touched. From the removal of the old manifest
    to the arrival of the new one the folder counts as unfinished, so a mixture is never read.
    """
    new = folder / UNFINISHED
    missions, steps = results.missions, io.BytesIO()
    results.steps.to_parquet(steps, index=False, compression="zstd")
    files = {
        CONFIG: (new / CONFIG).read_bytes(),
        # Times differ from run to run: without them the same missions make the same file.
        MISSIONS: csv_text(missions.drop(columns="seconds")).encode(),
        STEPS: steps.getvalue(),
        COMPUTE: csv_text(compute(missions, errors or {})).encode(),
        measures.FILE: results.measures.to_json().encode(),
    }
    shutil.rmtree(new / READY, ignore_errors=True)
    for name, data in files.items():
        write_whole(new / READY / name, data)
    write_manifest(new / READY, files)
    (folder / MANIFEST).unlink(missing_ok=True)
    for name in DRAWN:
        shutil.rmtree(folder / name, ignore_errors=True)
    for name in (*files, MANIFEST):
        os.replace(new / READY / name, folder / name)
    sync_folder(folder)
    (new / READY).rmdir()
    for path in new.iterdir():
        if path.name != CONFIG:
            path.unlink()
    (new / CONFIG).unlink()  # the last one: as long as it is there, there is something to do
    new.rmdir()


def compute(missions: pd.DataFrame, errors: Mapping[str, float]) -> pd.DataFrame:
    """Return what each method took: one core's time, summed over its missions.

    Beside it stand held-out ``errors`` of what was trained before.

    >>> import pandas as pd
    >>> row = {"method": "a", "steps": 99, "seconds": 0.5}
    >>> compute(pd.DataFrame([row, row]), {"flow": 0.1}).to_dict("records")
    [{'method': 'a', 'missions': 2, 'steps': 200, 'seconds': 1.0, 'flow_error': 0.1}]
    """
    rows = missions.assign(missions=1, steps=missions["steps"] + 1)  # the last step's number
    columns = ["missions", "steps", "seconds"]
    rows = rows.groupby("method", sort=False)[columns].sum().reset_index()
    return rows.assign(**{f"{title}_error": error for title, error in errors.items()})


class Stop:
    """Ends a run on request: between two steps of its missions, else at once.

    Attributes:
        asked: whether it was told to.
        waits: whether there is a step to wait for.
    """

    def __init__(self) -> None:
        self.asked, self.waits = False, False

    def __call__(self, number: int = 0, frame: FrameType | None = None) -> None:
        """Ask the run to end; a handler of signals.

        Raises:
            KeyboardInterrupt: if there is no step to wait for, or if asked twice.
        """
        again, self.asked = self.asked, True
        if again or not self.waits:
            raise KeyboardInterrupt
