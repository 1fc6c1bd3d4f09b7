"""Missions that reach one target after the other."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from afm_rl.missions.score import Score
from afm_rl.storage.measures import Measure, Measures


class LapScore(Score):
    """How many targets were reached, and in how many steps.

    Table: ``success_rate``, the share of targets reached; ``steps``; ``reached``; ``targets``;
    ``finished``, whether all were.
    """

    measures = Measures(
        (
            Measure(
                *("success_rate", "success", "targets reached", "%", "higher"),
                scale=100.0,
                digits=1,
                limits=(0.0, 1.0),
                headline=True,
            ),
            Measure("steps", "steps", "steps", better="lower", headline=True, budget=True),
        ),
        progress=("reached", "targets"),
        error_unit="m, rad",
    )
    columns = ("reached",)
    whole = ("reached",)
    reads = ("goal", "reached")

    def goal(self, td: TensorDictBase) -> Tensor:
        return td["goal"]

    def row(self, td: TensorDictBase) -> Tensor:
        """Return the number of targets reached before the step."""
        return td["reached"].float().unsqueeze(-1)

    def start(self, missions: TensorDictBase) -> dict[str, Tensor]:
        return {"reached": torch.zeros(len(missions))}

    def add(self, sums: dict[str, Tensor], ids: Tensor, td: TensorDictBase) -> None:
        sums["reached"][ids] = td["next", "reached"].float()

    def table(
        self, env: EnvBase, missions: TensorDictBase, sums: dict[str, Tensor]
    ) -> dict[str, Any]:
        reached = sums["reached"].int()
        targets = env.course.counts[missions["mission", "track"]].int()
        return {
            "success_rate": reached / targets,
            "steps": sums["steps"].int(),
            "reached": reached,
            "targets": targets,
            "finished": reached == targets,
        }
