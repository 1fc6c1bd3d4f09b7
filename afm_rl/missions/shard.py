"""The unit of work of a study: one method with one seed, on every track and regime."""

from __future__ import annotations

import io
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from omegaconf import DictConfig

from afm_rl import measures
from afm_rl.artefacts import write_whole
from afm_rl.missions.build import build
from afm_rl.missions.checkpoint import Stopped
from afm_rl.missions.lock import locked
from afm_rl.missions.prepare import prepare
from afm_rl.missions.run import Results, run
from afm_rl.missions.state import Loop

MISSIONS, STEPS = "missions.csv", "steps.parquet"
CHECKPOINT, ERROR = "checkpoint.safetensors", "error.txt"


class Shard(NamedTuple):
    """Which missions: all those of a method that have one seed.

    What a shard holds never depends on where a study was interrupted, and so neither do its
    results, whose last bits may depend on the company in the batch.
    """

    method: str
    seed: int

    def __str__(self) -> str:
        return f"{self.method}, seed {self.seed}"

    def folder(self, study: Path) -> Path:
        """Return where the shard's files stand."""
        return study / "shards" / self.method / str(self.seed)

    def finished(self, study: Path) -> bool:
        """Are there results? The table of missions is written last."""
        return (self.folder(study) / MISSIONS).exists()


def run_shard(
    study: Path,
    shard: Shard,
    cfg: DictConfig,
    every: float,
    watch: Callable[[Loop, int], bool],
) -> Results:
    """Run the missions of a shard, or go on with them, and write their tables.

    Args:
        study: folder of the study.
        shard: which missions.
        cfg: settings of the method.
        every: time between two checkpoints (s).
        watch: is shown the state after each step, and the number of missions; true stops.

    Raises:
        Stopped: if ``watch`` said so.
    """
    folder = shard.folder(study)
    with locked(folder, wait=True):  # an orphan of a killed study may be in its last step
        try:
            own = cfg.copy()
            own.seeds = [shard.seed]
            agent = build(own)
            prepare(agent, cfg.cache, echo=lambda line: None)
            total = len(agent.missions)
            results = run(
                agent, checkpoint=folder / CHECKPOINT, every=every, watch=lambda x: watch(x, total)
            )
            _write(folder, results)
        except Exception as error:
            if not isinstance(error, Stopped):
                write_whole(folder / ERROR, traceback.format_exc().encode())
            raise
        tidy(folder)
    return results


def tidy(folder: Path) -> None:
    """Remove what a shard with results needs no longer."""
    for path in [folder / CHECKPOINT, folder / ERROR, *folder.glob(f".{CHECKPOINT}.*")]:
        path.unlink(missing_ok=True)


def _write(folder: Path, results: Results) -> None:
    buffer = io.BytesIO()
    results.steps.to_parquet(buffer, index=False, compression="zstd")
    write_whole(folder / STEPS, buffer.getvalue())
    write_whole(folder / measures.FILE, results.measures.to_json().encode())
    table = results.missions.to_csv(index=False, lineterminator="\n")
    write_whole(folder / MISSIONS, table.encode())
