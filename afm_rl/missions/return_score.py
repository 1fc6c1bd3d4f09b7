"""Missions in which there are rewards to collect."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from afm_rl.missions.score import Score
from afm_rl.storage.measures import Measure, Measures


class ReturnScore(Score):
    r"""What was collected, before and after a change of the dynamics.

    Let the change be that to the first phase that is not nominal (to the second one, where all
    are), after c of T steps. Table: ``return``, the sum of rewards; ``before``, ``at`` and
    ``after``, mean rewards per step in the steps [c/2, c), [c, c + soon) and [(c + T)/2, T);
    ``recovery_steps``, the steps from c to the first ``soon`` whose mean reward reaches ``before``
    less the share that may be missing; ``steps``; ``terminated``, whether the task
    ended the episode before its last step. Steps after that have no reward. What does not exist is
    NaN.

    Args:
        steps: most steps of a mission.
        goal_names: coordinates of the goal, which are logged, too.
        soon: steps that count as "at" the change, and over which a recovery is measured.
        missing: share of the reward before that may be missing after a recovery.
    """

    measures = Measures(
        (
            Measure("return", "return", "return", digits=1, headline=True),
            Measure("before", "before", "reward per step before the change", digits=3),
            Measure("at", "at", "reward per step right after the change", digits=3),
            Measure("after", "after", "reward per step after the change", digits=3, headline=True),
            Measure(*("recovery_steps", "recovery", "steps until recovered", "", "lower")),
        )
    )
    reads = ("pose",)

    def __init__(
        self, steps: int, goal_names: Sequence[str] = (), soon: int = 20, missing: float = 0.1
    ) -> None:
        self.steps, self.soon, self.missing = steps, soon, missing
        self.columns = ("reward", *(f"goal_{name}" for name in goal_names))

    def goal(self, td: TensorDictBase) -> Tensor:
        """Return no coordinates: the goal need not be a place."""
        return td["observation"][..., :0]

    def row(self, td: TensorDictBase) -> Tensor:
        goal = [td["goal"]] if len(self.columns) > 1 else []
        return torch.cat([td["next", "reward"], *goal], -1)

    def start(self, missions: TensorDictBase) -> dict[str, Tensor]:
        count = len(missions)
        return {"rewards": torch.zeros(count, self.steps), "terminated": torch.zeros(count)}

    def add(self, sums: dict[str, Tensor], ids: Tensor, td: TensorDictBase) -> None:
        reward = td["next", "reward"].squeeze(-1)
        sums["rewards"][ids, td["step"]] = reward.to(sums["rewards"])
        sums["terminated"][ids] = td["next", "terminated"].squeeze(-1).to(sums["terminated"])

    def table(
        self, env: EnvBase, missions: TensorDictBase, sums: dict[str, Tensor]
    ) -> dict[str, Any]:
        steps = env.simulation.steps
        rewards = sums["rewards"][:, :steps].cpu().double()
        parts = zip(rewards, env.simulation.changes_at(missions["mission"]).tolist(), strict=True)
        measured = [_measured(row, at, self.soon, self.missing) for row, at in parts]
        rows = torch.tensor(measured, dtype=torch.float64)
        names = ("before", "at", "after", "recovery_steps")
        return {
            "return": rewards.sum(1),
            **dict(zip(names, rows.unbind(-1), strict=True)),
            "steps": sums["steps"].int(),
            "terminated": sums["terminated"] == 1,
        }


def _measured(rewards: Tensor, change: int, soon: int = 20, missing: float = 0.1) -> list[float]:
    """Return the mean rewards before, at and after a change, and the steps of the recovery.

    >>> _measured(torch.tensor([1.0] * 100 + [0.0] * 30 + [1.0] * 70), change=100)
    [1.0, 0.0, 1.0, 28.0]
    """
    middle = (change + len(rewards)) // 2
    spans = (change // 2, change), (change, change + soon), (middle, len(rewards))
    before, at, after = (rewards[a:b].mean().item() for a, b in spans)
    later, recovery = rewards[change:], math.nan
    if len(later) >= soon:
        means = later.unfold(0, soon, 1).mean(-1)
        good = (means >= before - missing * abs(before)).nonzero()
        recovery = float(good[0]) if len(good) else math.nan
    return [before, at, after, recovery]
