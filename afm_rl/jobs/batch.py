"""Batches: the jobs of a comparison, a sweep or a study, in a folder that can be returned to."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig
from yaml import safe_dump

from afm_rl.errors import ConfigurationError
from afm_rl.jobs.executor import Board, Executor
from afm_rl.jobs.layout import is_batch, is_finished, job_folder, job_folders, recorded
from afm_rl.jobs.process import Job
from afm_rl.jobs.run import begin, needs_run
from afm_rl.storage.files import csv_text, locked, remove_parts, write_whole
from afm_rl.storage.manifest import COMPUTE, MANIFEST, MISSIONS, RECORD, write_manifest
from afm_rl.trust import trusted

if TYPE_CHECKING:
    import pandas as pd


def run_batch(
    folder: Path,
    configs: Mapping[str, DictConfig],
    executor: Executor,
    *,
    command: str = "",
    overwrite: bool = False,
    progress: bool = False,
    echo: Callable[[str], object] = print,
) -> dict[str, str]:
    """Run the jobs of a batch, or what is left of them.

    Jobs that have results are skipped; those that were killed go on from their last checkpoint,
    with the same results to the bit. Files: see :mod:`afm_rl.jobs.layout`.

    Args:
        folder: the batch's own; more jobs extend a batch that is there.
        configs: settings of each job, by name; each of one method, with its label.
        executor: where the jobs run.
        command: what the user asked, for people.
        overwrite: run jobs again that have results; these stay until the new ones are whole.
        progress: show progress.
        echo: receives lines of text.

    Returns:
        Why jobs have no results, by name.

    Raises:
        ConfigurationError: if the folder holds something else, or another process is at work in it.
        ArtefactError: if results in it are damaged.
    """
    if not is_batch(folder) and (folder / MISSIONS).exists():
        raise ConfigurationError(
            f"hydra.run.dir={folder}: holds the results of a run; choose another folder"
        )
    surroundings = (Path.cwd(), trusted())
    jobs = [Job(name, job_folder(folder, name), *surroundings) for name in configs]
    with locked(folder):
        waiting = [job for job in jobs if needs_run(job.folder, configs[job.name], overwrite)]
        remove_parts(folder)
        _record(folder, jobs, command)
        for job in waiting:
            begin(job.folder, configs[job.name])
        if len(waiting) < len(jobs):
            echo(f"{len(jobs) - len(waiting)} of {len(jobs)} jobs have results already")
        with Board(waiting, len(jobs), progress, echo) as board:
            failures = executor.run(waiting, board)
        write_tables(folder)
        return failures


def _record(folder: Path, jobs: Sequence[Job], command: str) -> None:
    """Write down which jobs are asked for; those of earlier commands stay."""
    names = [job.folder.name for job in jobs]
    names += [name for name in recorded(folder) if name not in names]
    (folder / MANIFEST).unlink(missing_ok=True)
    text = safe_dump({"command": command, "jobs": names}, sort_keys=False)
    write_whole(folder / RECORD, text.encode())
    write_manifest(folder, [RECORD])


def write_tables(folder: Path) -> None:
    """Write ``missions.csv`` and ``compute.csv`` of a batch, and its manifest.

    ``missions.csv`` holds nothing that depends on the clock, so it is the same to the byte however
    often the batch was interrupted.
    """
    import pandas as pd

    (folder / MANIFEST).unlink(missing_ok=True)
    runs = [run for run in job_folders(folder) if is_finished(run) and (run / MISSIONS).exists()]
    if runs:
        # As text, so that numbers come out as they went in.
        texts = [pd.read_csv(run / MISSIONS, dtype=str, keep_default_na=False) for run in runs]
        taken = pd.concat([pd.read_csv(run / COMPUTE) for run in runs])
        how = {name: "mean" if name.endswith("_error") else "sum" for name in taken.columns[1:]}
        whole = taken.groupby("method", sort=False).agg(how).reset_index()
        write_whole(folder / MISSIONS, csv_text(join(texts)).encode())
        write_whole(folder / COMPUTE, csv_text(whole).encode())
    write_manifest(folder, [n for n in (RECORD, MISSIONS, COMPUTE) if (folder / n).exists()])


def join(tables: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """Put the tables of jobs into one, missions numbered through.

    Methods keep the order in which they come first.

    >>> import pandas as pd
    >>> one = pd.DataFrame({"mission": [0, 1], "method": "a", "track": ["x", "y"], "seed": 7})
    >>> join([one, one.assign(seed=3)])[["mission", "track", "seed"]].values.tolist()
    [[0, 'x', 3], [1, 'x', 7], [2, 'y', 3], [3, 'y', 7]]
    """
    import pandas as pd

    whole = pd.concat(tables, ignore_index=True)
    keys = whole[["method", "mission", "seed"]].astype({"mission": int, "seed": int})
    keys["method"] = pd.factorize(keys["method"])[0]
    order = keys.sort_values(list(keys), kind="stable").index
    return whole.loc[order].assign(mission=range(len(whole))).reset_index(drop=True)
