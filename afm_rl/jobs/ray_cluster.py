"""Jobs on a Ray cluster."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

from afm_rl.errors import check_number
from afm_rl.jobs.executor import Executor
from afm_rl.jobs.process import Job, needs, run


class RayExecutor(Executor):
    """Runs each job on a node of a Ray cluster that has room for it.

    Args:
        address: of the cluster, as ``ray.init`` takes it; None for the one that ``RAY_ADDRESS``
            names, or else one of this machine that lasts as long as the command.
        num_cpus: cores that a job takes up.
        num_gpus: GPUs that a job takes up.

    Raises:
        ConfigurationError: for a negative number, or if Ray is not installed.
    """

    def __init__(
        self, address: str | None = None, num_cpus: float = 1, num_gpus: float = 0
    ) -> None:
        self.address = address
        self.resources = {
            "num_cpus": check_number("hydra.launcher.num_cpus", num_cpus, low=0),
            "num_gpus": check_number("hydra.launcher.num_gpus", num_gpus, low=0),
        }
        self.ray = needs("ray", "ray")

    def start(self, jobs: Sequence[Job]) -> Sequence[Any]:
        self.ray.init(self.address, log_to_driver=False, ignore_reinit_error=True)
        # Not tried again elsewhere: a job that outgrows a node would bring down the next one.
        remote = self.ray.remote(max_retries=0, **self.resources)(run)
        return [remote.remote(job) for job in jobs]

    def is_over(self, handle: Any) -> bool:
        return bool(self.ray.wait([handle], timeout=0)[0])

    def last_words(self, handle: Any) -> str:
        try:
            self.ray.get(handle)
        except self.ray.exceptions.RayError as error:
            return str(error).splitlines()[0]
        return super().last_words(handle)

    def close(self, handles: Collection[Any]) -> None:
        self.ray.shutdown()
