"""Jobs on a Ray cluster."""

from __future__ import annotations

from collections.abc import Sequence

from afm_rl.cli.launchers.base import JobLauncher, needs
from afm_rl.errors import check_number
from afm_rl.jobs.process import Ends, Job, run

TICK = 0.5  # seconds between two signs of life


class RayLauncher(JobLauncher):
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
        super().__init__()
        self.address = address
        self.resources = {
            "num_cpus": check_number("hydra.launcher.num_cpus", num_cpus, low=0),
            "num_gpus": check_number("hydra.launcher.num_gpus", num_gpus, low=0),
        }
        self.ray = needs("ray", "ray")

    def run(self, jobs: Sequence[Job]) -> Ends:
        if not jobs:
            return
        ray = self.ray
        with ray.init(self.address, log_to_driver=False, ignore_reinit_error=True):
            # Not tried again elsewhere: a job that outgrows a node would bring down the next one.
            remote = ray.remote(max_retries=0, **self.resources)(run)
            running = {remote.remote(job): job for job in jobs}
            while running:
                ready, _ = ray.wait(list(running), timeout=TICK)
                for handle in ready:
                    job = running.pop(handle)
                    try:
                        yield job, ray.get(handle)
                    except ray.exceptions.RayError as error:
                        yield job, str(error).splitlines()[0]
                yield None
