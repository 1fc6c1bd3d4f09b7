"""Sweeps on this machine."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from afm_rl.cli.launchers.base import JobLauncher
from afm_rl.cli.launchers.job import Job, run
from afm_rl.errors import ConfigurationError


class JoblibLauncher(JobLauncher):
    """Runs some jobs at a time, with joblib.

    Its own worker processes would all be lost with one that is killed; here each job has its own
    process, and joblib's threads wait for them.

    Args:
        n_jobs: jobs at a time; -1 means one per core, -2 one less, and so on.

    Raises:
        ConfigurationError: if ``n_jobs`` is no whole number, or 0.
    """

    def __init__(self, n_jobs: int = -1) -> None:
        super().__init__()
        if isinstance(n_jobs, bool) or not isinstance(n_jobs, int) or n_jobs == 0:
            raise ConfigurationError(
                f"hydra.launcher.n_jobs={n_jobs!r}: expected a whole number other than 0"
            )
        self.n_jobs = n_jobs

    def run(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, str | None]]:
        from joblib import Parallel, delayed

        pool = Parallel(self.n_jobs, backend="threading", return_as="generator_unordered")
        return pool(delayed(_with_reason)(job) for job in jobs)


def _with_reason(job: Job) -> tuple[Job, str | None]:
    return job, run(job)
