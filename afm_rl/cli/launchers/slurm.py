"""Sweeps on a SLURM cluster."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from afm_rl.cli.launchers.base import JobLauncher, needs
from afm_rl.cli.launchers.job import Job, run
from afm_rl.errors import ConfigurationError, check_choice

POLL = 2.0  # seconds between two looks at jobs; the cluster itself is asked more rarely


class SubmititLauncher(JobLauncher):
    """Submits each job to SLURM, or runs it as if, with submitit.

    Args:
        cluster: ``slurm``, or ``local`` for this machine.
        parameters: of ``submitit.AutoExecutor.update_parameters``; those that are None are left to
            the cluster.

    Raises:
        ConfigurationError: for another cluster, or if submitit is not installed.
    """

    def __init__(self, cluster: str, parameters: Mapping[str, Any]) -> None:
        super().__init__()
        self.cluster = check_choice("hydra.launcher.cluster", cluster, ("local", "slurm"))
        self.parameters = {key: value for key, value in parameters.items() if value is not None}
        self.submitit = needs("submitit", "sweeps")

    def run(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, str | None]]:
        folder = jobs[0].folder.parent / ".submitit"
        try:
            executor = self.submitit.AutoExecutor(folder, cluster=self.cluster)
            executor.update_parameters(**{"name": "afm-rl"} | self.parameters)
        except (RuntimeError, NameError, TypeError) as error:  # no cluster, no such parameter
            raise ConfigurationError(f"hydra.launcher: {error}") from error
        with executor.batch():
            handles = [executor.submit(run, job) for job in jobs]
        jobs_by_handle = dict(zip(handles, jobs, strict=True))
        for handle in self.submitit.helpers.as_completed(handles, poll_frequency=POLL):
            yield jobs_by_handle[handle], _outcome(handle)


def _outcome(handle: Any) -> str | None:
    """Return what became of a job, also if its node or the cluster ended it."""
    try:
        return handle.result()
    except Exception as error:
        return f"{str(error).splitlines()[0]} ({handle.paths.stderr})"
