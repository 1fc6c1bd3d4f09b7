"""Jobs on a SLURM cluster."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from afm_rl.cli.launchers.base import JobLauncher, needs
from afm_rl.errors import ConfigurationError, check_choice
from afm_rl.jobs.process import Ends, Job, run

POLL = 0.5  # seconds between two looks at jobs; the cluster itself is asked more rarely


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

    def run(self, jobs: Sequence[Job]) -> Ends:
        if not jobs:
            return
        folder = jobs[0].folder.parent.parent / ".submitit"
        try:
            executor = self.submitit.AutoExecutor(folder, cluster=self.cluster)
            executor.update_parameters(**{"name": "afm-rl"} | self.parameters)
        except (RuntimeError, NameError, TypeError) as error:  # no cluster, no such parameter
            raise ConfigurationError(f"hydra.launcher: {error}") from error
        with executor.batch():
            running = {executor.submit(run, job): job for job in jobs}
        while running:
            for handle in [handle for handle in running if handle.done()]:
                yield running.pop(handle), _outcome(handle)
            yield None
            time.sleep(POLL)


def _outcome(handle: Any) -> str | None:
    """Return what became of a job, also if its node or the cluster ended it."""
    try:
        return handle.result()
    except Exception as error:
        return f"{str(error).splitlines()[0]} ({handle.paths.stderr})"
