"""Jobs on a SLURM cluster."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from afm_rl.errors import ConfigurationError, check_choice
from afm_rl.jobs.executor import Executor
from afm_rl.jobs.process import Job, needs, run


class SubmititExecutor(Executor):
    """Submits jobs to SLURM as one array, or runs them as if, with submitit.

    submitit hands a job to its node as a pickle. It is in a new folder that only the user can
    enter, and holds the name of :func:`~afm_rl.jobs.process.run` and a :class:`Job`. What comes
    back is not read, but what the job leaves in its own folder. The new folder goes when all jobs
    are over; if the command is ended before, it stays, since the queue needs it.

    Args:
        cluster: ``slurm``, or ``local`` for this machine.
        parameters: of ``submitit.AutoExecutor.update_parameters``; those that are None are left to
            the cluster.

    Raises:
        ConfigurationError: for another cluster, or if submitit is not installed.
    """

    def __init__(self, cluster: str = "slurm", parameters: Mapping[str, Any] | None = None) -> None:
        self.cluster = check_choice("hydra.launcher.cluster", cluster, ("local", "slurm"))
        given = {key: value for key, value in (parameters or {}).items() if value is not None}
        self.parameters = {"name": "afm-rl"} | given
        self.submitit = needs("submitit", "sweeps")
        self.private = ""

    def start(self, jobs: Sequence[Job]) -> Sequence[Any]:
        self.private = tempfile.mkdtemp(prefix=".submitit-", dir=jobs[0].folder.parent.parent)
        try:
            executor = self.submitit.AutoExecutor(self.private, cluster=self.cluster)
            executor.update_parameters(**self.parameters)
            return executor.map_array(run, jobs)
        except (RuntimeError, NameError, TypeError) as error:  # no cluster, no such parameter
            raise ConfigurationError(f"hydra.launcher: {' '.join(str(error).split())}") from error

    def is_over(self, handle: Any) -> bool:
        return handle.done()

    def last_words(self, handle: Any) -> str:
        said = (handle.stderr() or "").splitlines() or ["no word on standard error"]
        return f"it ended in state {handle.state} before its results were whole: {said[-1]}"

    def close(self, handles: Collection[Any]) -> None:
        if not handles:  # else they stay in the queue, with their pickles
            shutil.rmtree(self.private, ignore_errors=True)
