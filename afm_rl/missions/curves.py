"""Curves of missions under way, for TensorBoard."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from afm_rl.errors import refusing

if TYPE_CHECKING:
    import pandas as pd
    from torchrl.record.loggers import TensorboardLogger

    from afm_rl.missions.build import Agent
    from afm_rl.missions.state import Loop

EVERY = 20  # steps
TAGS = {
    "corrected": "correction/corrected",
    "miss": "correction/miss",
    "unforeseen": "correction/unforeseen",
    "noise": "correction/noise",
    "error": "model/error",
    "innovation": "model/innovation",
    "loss": "model/loss",
}
"""Where a figure of a step is shown; those of the task, such as a reward, under ``task/``."""
HYPERPARAMETERS = ("planner", "cost", "dynamics", "updater", "corrector", "budget")


class Curves:
    """The curves of one method, written with TorchRL's logger while its missions run.

    A point is the mean of ``every`` steps over the missions that run in them:

    * ``correction/miss`` and ``correction/unforeseen``, the distances from what was planned and
      from what the corrector predicted; of what corrects also ``corrected``, the share of corrected
      steps, ``noise``, in half ranges of the actions, and ``probability``, that of the likeliest
      cause at this step,
    * ``model/error``, ``model/innovation``, in standard deviations of the model, ``model/loss``,
    * ``task/...``: what the robot's score logs, such as the targets ``reached``,
    * ``time/ms_per_step`` and ``time/missions``, those that still run.

    At the end follow ``final/COLUMN``, the mean of each measure, and the hyperparameters.

    Args:
        folder: of the curves; that they are read from while they are written does no harm.
        every: steps of a point.
    """

    def __init__(self, folder: Path, every: int = EVERY) -> None:
        self.folder, self.every = folder, every
        self._logger: TensorboardLogger | None = None
        self._clock = time.perf_counter()
        self._sums: dict[str, Tensor] = {}
        self._count = 0

    @property
    def logger(self) -> TensorboardLogger:
        """Made when there is something to write: TensorBoard takes a second to load."""
        if self._logger is None:
            from torchrl.record.loggers import TensorboardLogger

            with refusing(f"cannot write {self.folder}"):
                self._logger = TensorboardLogger(self.folder.name, str(self.folder.parent))
        return self._logger

    def add(self, agent: Agent, loop: Loop, figures: Mapping[str, Tensor]) -> None:
        """Add the figures of a step, each ``(B,)``; write a point if enough steps are together.

        Args:
            agent: whose missions they are.
            loop: where these stand after the step.
            figures: by name.
        """
        self._count += len(next(iter(figures.values())))
        for name, values in figures.items():
            self._sums[name] = self._sums.get(name, 0.0) + values.sum(dtype=torch.float64)
        if loop.step % self.every:
            return
        point = {
            TAGS.get(name, f"task/{name}"): value.item() / self._count
            for name, value in self._sums.items()
        }
        progress = agent.robot.metrics.measures.progress
        if progress and progress[0] in loop.ends:  # of missions that have ended, too
            point[f"task/{progress[0]}"] = loop.ends[progress[0]].mean().item()
        if len(loop.ids) and (probability := likeliest(agent)) is not None:
            point["correction/probability"] = probability
        now = time.perf_counter()
        point["time/ms_per_step"] = 1000 * (now - self._clock) / self.every
        point["time/missions"] = len(loop.ids)
        self._write(point, loop.step)
        self._clock, self._sums, self._count = now, {}, 0

    def end(self, agent: Agent, missions: pd.DataFrame) -> None:
        """Write the measures of all missions, the means of their table, and the hyperparameters."""
        final = {
            f"final/{measure.column}": float(missions[measure.column].mean())
            for measure in agent.robot.metrics.measures
        }
        settings = hyperparameters({"method": agent.label, **agent.settings})
        self.logger.experiment.flush()
        # In the folder of the curves, not in one beside them that is named after the time.
        self.logger.experiment.add_hparams(settings, final, run_name=".")
        self.close()

    def close(self) -> None:
        """Close the files."""
        if self._logger is not None:
            self._logger.experiment.close()
            self._logger = None

    def _write(self, point: Mapping[str, float], step: int) -> None:
        for tag, value in point.items():
            self.logger.log_scalar(tag, value, step)
        self.logger.experiment.flush()  # seen at once, and kept if this process is killed


def likeliest(agent: Agent) -> float | None:
    """Return the probability of the likeliest cause, the mean over missions and actuators.

    None if the corrector believes in no causes.
    """
    transform = agent.transform
    if transform is None or not transform.corrector.causes:
        return None
    belief = transform.corrector.belief_in(transform.memory)  # (B, causes, A)
    return belief.amax(-2).mean().item()


def hyperparameters(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that methods differ in, as TensorBoard shows them: flat, and plain.

    >>> hyperparameters({"planner": {"horizon": 5, "seed_key": ["a", "b"]}, "cache": "here"})
    {'planner.horizon': 5, 'planner.seed_key': "['a', 'b']"}
    """
    found: dict[str, Any] = {}

    def collect(place: str, value: Any) -> None:
        if isinstance(value, Mapping):
            for key, part in value.items():
                collect(f"{place}.{key}", part)
        else:
            found[place] = value if isinstance(value, bool | int | float | str) else str(value)

    for name in ("method", *HYPERPARAMETERS):
        if name in settings:
            collect(name, settings[name])
    return found
