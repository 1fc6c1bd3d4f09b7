"""One job of a sweep: how it is run, and what is left of it.

Imported on the nodes of a cluster as well, where jobs are merely waited for: keep it light.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

FINISHED, LOG = "finished", "log.txt"
SAYS = "afm-rl: "  # begins the last line of a program that knows why it ends
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@dataclass(frozen=True)
class Job:
    """What a job is.

    Attributes:
        folder: the job's own, in which its results go.
        digest: of its settings.
        name: what sets it apart from the other jobs.
        arguments: of the command line, but for the folder.
        cwd: where the command was given, which relative paths are relative to.
    """

    folder: Path
    digest: str
    name: str
    arguments: tuple[str, ...]
    cwd: Path

    def __str__(self) -> str:
        return f"job {self.folder.name}" + (f" ({self.name})" if self.name else "")

    @property
    def finished(self) -> bool:
        """Are there results? The file that says so is written last."""
        marker = self.folder / FINISHED
        return marker.is_file() and marker.read_text().strip() == self.digest


def run(job: Job) -> str | None:
    """Run a job in a process of its own, which ends if this one does.

    Returns:
        Why there are no results; None if there are.
    """
    child = [sys.executable, "-m", "afm_rl.cli.launchers.child", str(job.folder), job.digest]
    try:
        with open(job.folder / LOG, "ab+") as log:
            start = log.tell()
            with subprocess.Popen(
                [*child, *job.arguments],
                cwd=job.cwd,
                env=ONE_THREAD | os.environ,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
            ) as process:
                status = process.wait()
            log.seek(start)
            said = log.read().decode(errors="replace").splitlines()
        return None if job.finished else _reason(status, said)
    except OSError as error:
        return f"{error.filename or job.folder}: {error.strerror}"


def _reason(status: int, said: list[str]) -> str:
    """Say why a process that ended with ``status`` has no results.

    >>> _reason(2, ["...", "afm-rl: budget=0: expected a whole number of at least 1"])
    'budget=0: expected a whole number of at least 1'
    >>> _reason(0, ["..."])
    'its process ended with status 0 before its results were whole'
    """
    if status > 0 and said and said[-1].startswith(SAYS):
        return said[-1].removeprefix(SAYS)
    if status == 0:
        return "its process ended with status 0 before its results were whole"
    from afm_rl.missions.study_crew import last_words  # with torch, which is not light

    return last_words(status)
