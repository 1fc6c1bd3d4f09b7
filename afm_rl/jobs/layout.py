"""The folders of runs, comparisons, sweeps and studies.

A *run* is the missions of one method in one folder::

    FOLDER/
      missions.csv         one row per mission; nothing in it depends on the clock
      steps.parquet        one row per mission and step
      compute.csv          method, missions, steps, seconds that the run took, held-out errors
      config.yaml          the settings, resolved
      tensorboard/METHOD/  curves, written while the missions run
      diagnosis/, figures/, video/
      manifest.json        the SHA-256 of all of these; a folder with a manifest is finished
      log.txt              what its process printed, if it had one of its own
      unfinished/          until then: config.yaml, checkpoints, progress.txt

A comparison, a sweep and a study are a *batch*: several runs, called jobs, each as above::

    FOLDER/
      jobs.yaml            command: what was asked; jobs: their names, in the order of the tables
      jobs/NAME/           a run; NAME is such as physics, physics+planner.horizon=5 or
                           physics+seed=3, with _ for what a file name cannot hold
      missions.csv         the missions of all jobs, numbered through: written at the end
      compute.csv          one row per method
      tensorboard/NAME/    curves of each job, written while it runs
      diagnosis/, figures/, video/ or report/
      manifest.json        of the files above that are not in a job's folder

``config.yaml`` of a job names its method in ``label``, and its ``seeds``, ``tracks`` and
``regimes``. The column ``method`` of its tables is this label. Labels of a sweep's jobs name the
settings that are swept: ``physics+planner.horizon=5``.
"""

from __future__ import annotations

from pathlib import Path

from afm_rl.errors import ArtefactError, refusing
from afm_rl.storage.files import file_name, read_settings
from afm_rl.storage.manifest import JOBS, MANIFEST, RECORD, read_verified

LOG = "log.txt"


def is_batch(folder: Path) -> bool:
    """Return whether a folder holds several runs."""
    return (folder / JOBS).is_dir()


def is_finished(folder: Path) -> bool:
    """Return whether a run has its results. What they hold is checked by ``check_manifest``."""
    return (folder / MANIFEST).is_file()


def job_folder(folder: Path, name: str) -> Path:
    """Return the folder of a batch's job."""
    return folder / JOBS / file_name(name)


def job_folders(folder: Path) -> list[Path]:
    """Return the folders of a batch's jobs, finished or not, in the order of ``jobs.yaml``."""
    return [folder / JOBS / name for name in recorded(folder)]


def recorded(folder: Path) -> list[str]:
    """Return the names of a batch's jobs in the order of the tables, from ``jobs.yaml``."""
    path = folder / RECORD
    if not path.exists():
        return []
    # Without a manifest it is about to be written again.
    settings = read_settings(path, read_verified(folder, RECORD) if is_finished(folder) else None)
    with refusing(f"{path}: damaged; delete it", ArtefactError):
        return [str(name) for name in settings["jobs"]]
