"""What is logged of a kind of mission, and the measures by which methods are compared."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from afm_rl.errors import ConfigurationError
from afm_rl.options import NonNegative, Positive, options
from afm_rl.storage.measures import Measure, Measures

Sums = dict[str, Tensor]
"""What is summed up of missions, by name, a row for each."""


class Score(ABC):
    """What is logged of a kind of mission, what is summed up, and what its table says.

    Attributes:
        measures: the columns of :meth:`table` by which methods are compared. Runs store them with
            their results, and reports know nothing else of a kind of mission.
        columns: names of the numbers that :meth:`row` logs, the last columns of the steps.
        whole: those that are whole numbers.
        reads: entries of the environment without which there is no score.
    """

    measures: ClassVar[Measures]
    columns: Sequence[str] = ()
    whole: Sequence[str] = ()
    reads: Sequence[str] = ()

    def check(self, env: EnvBase, goal_names: Sequence[str]) -> None:
        """Check that the environment gives what the score reads.

        Raises:
            ConfigurationError: otherwise, or if there are not as many names as goal coordinates.
        """
        missing = [key for key in self.reads if key not in env.observation_spec.keys()]
        if missing:
            raise ConfigurationError(
                f"robot.score={type(self).__name__}: reads {', '.join(self.reads)}, but the "
                f"environment gives no {', '.join(missing)}"
            )
        size = self.goal(env.observation_spec.zero()).shape[-1]
        if len(goal_names) != size:
            raise ConfigurationError(f"robot.goal_names={list(goal_names)}: expected {size} names")

    @abstractmethod
    def goal(self, td: TensorDictBase) -> Tensor:
        """Return where missions are to go now, ``(*B, G)``."""

    @abstractmethod
    def row(self, td: TensorDictBase) -> Tensor:
        """Return what is logged of a step with its outcome, ``(B, C)``."""

    @abstractmethod
    def start(self, missions: TensorDictBase) -> Sums:
        """Return the sums before the first step, a row for every mission."""

    @abstractmethod
    def add(self, sums: Sums, ids: Tensor, td: TensorDictBase) -> None:
        """Add a step with its outcome to the sums of the missions ``ids``, in place."""

    @abstractmethod
    def table(self, env: EnvBase, missions: TensorDictBase, sums: Sums) -> dict[str, Any]:
        """Return the columns of the table of missions.

        Among them ``finished``, whether the mission reached its goal, or ``terminated``, whether
        the episode ended early, where there is none.

        Args:
            env: where the missions were.
            missions: what they were.
            sums: all sums, and ``steps``, the number of each mission's last step.
        """


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

    def start(self, missions: TensorDictBase) -> Sums:
        return {"reached": torch.zeros(len(missions))}

    def add(self, sums: Sums, ids: Tensor, td: TensorDictBase) -> None:
        sums["reached"][ids] = td["next", "reached"].float()

    def table(self, env: EnvBase, missions: TensorDictBase, sums: Sums) -> dict[str, Any]:
        reached = sums["reached"].int()
        targets = env.course.counts[missions["mission", "track"]].int()
        return {
            "success_rate": reached / targets,
            "steps": sums["steps"].int(),
            "reached": reached,
            "targets": targets,
            "finished": reached == targets,
        }


class ReturnScore(Score):
    r"""What was collected, before and after a change of the dynamics.

    Let the change be that to the first phase that is not nominal (to the second one, where all
    are), after c of T steps. Table: ``return``, the sum of rewards; ``before``, ``at`` and
    ``after``, mean rewards per step in the steps [c/2, c), [c, c + 20) and [(c + T)/2, T);
    ``recovery_steps``, the steps from c to the first 20 whose mean reward reaches nine tenths of
    ``before``; ``steps``; ``terminated``, whether the task
    ended the episode before its last step. Steps after that have no reward. What does not exist is
    NaN.

    Args:
        steps: most steps of a mission.
        goal_names: coordinates of the goal, which are logged, too.
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

    def __init__(self, steps: int, goal_names: Sequence[str] = ()) -> None:
        self.steps = steps
        self.columns = ("reward", *(f"goal_{name}" for name in goal_names))

    def goal(self, td: TensorDictBase) -> Tensor:
        """Return no coordinates: the goal need not be a place."""
        return td["observation"][..., :0]

    def row(self, td: TensorDictBase) -> Tensor:
        goal = [td["goal"]] if len(self.columns) > 1 else []
        return torch.cat([td["next", "reward"], *goal], -1)

    def start(self, missions: TensorDictBase) -> Sums:
        count = len(missions)
        return {"rewards": torch.zeros(count, self.steps), "terminated": torch.zeros(count)}

    def add(self, sums: Sums, ids: Tensor, td: TensorDictBase) -> None:
        reward = td["next", "reward"].squeeze(-1)
        sums["rewards"][ids, td["step"]] = reward.to(sums["rewards"])
        sums["terminated"][ids] = td["next", "terminated"].squeeze(-1).to(sums["terminated"])

    def table(self, env: EnvBase, missions: TensorDictBase, sums: Sums) -> dict[str, Any]:
        steps = env.simulation.steps
        rewards = sums["rewards"][:, :steps].cpu().double()
        parts = zip(rewards, env.simulation.changes_at(missions["mission"]).tolist(), strict=True)
        measured = [_measured(row, at) for row, at in parts]
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


UP = 2  # index of the z axis


class TrackingScore(Score):
    r"""How far missions were from a reference, and how soon they were back after a change.

    Table: ``mse``, the mean of the squared error over steps and axes (m^2); ``mse_z``, that of
    the z axis; ``mse_phase_k`` in each phase; ``peak_z``, the largest :math:`|e_z|` after a step
    (m); ``settle_k``, the time (s) from the beginning of phase k > 0 to that of the first stretch
    of ``hold`` seconds in which :math:`|e_z|` is below ``band`` after each step; ``steps``;
    ``finished``, whether the mission was not lost. A number that does not exist is NaN.

    """

    measures = Measures(
        (
            Measure(*("mse", "MSE", "mean squared error", "m²", "lower"), digits=5, headline=True),
            Measure("mse_z", "MSE of z", "the same along z", "m²", "lower", digits=5),
            Measure("peak_z", "peak of z", "largest error along z", "m", "lower", digits=3),
        ),
        error_unit="m, m/s, rad, rad/s",
    )
    columns = ("square_error_x", "square_error_y", "square_error_z", "phase")
    whole = ("phase",)
    reads = ("reference", "square_error", "pose", "phase", "step", "since", "lost")

    @options("score")
    def __init__(
        self,
        dt: Annotated[Positive, "time of a step, s"],
        band: Annotated[
            Positive, "error of the height below which a flight counts as settled, m"
        ] = 0.02,
        hold: Annotated[NonNegative, "time for which the error must stay below it, s"] = 0.2,
    ) -> None:
        self.dt, self.band, self.hold = dt, band, max(1, math.ceil(hold / dt - 1e-6))

    def goal(self, td: TensorDictBase) -> Tensor:
        return td["reference"][..., 0, :3]

    def row(self, td: TensorDictBase) -> Tensor:
        """Return the squared error of the step, per axis, and the phase."""
        square = td["next", "square_error"]
        return torch.cat([square, td["phase"].unsqueeze(-1).to(square)], -1)

    def start(self, missions: TensorDictBase) -> Sums:
        count, phases = missions["mission", "parameters"].shape[:2]
        return {
            "square_error": torch.zeros(count, phases, 3),
            "flown": torch.zeros(count, phases),
            "peak_z": torch.zeros(count),
            "calm": torch.zeros(count),
            "settle": torch.full((count, phases), math.nan),
            "lost": torch.zeros(count),
        }

    def add(self, sums: Sums, ids: Tensor, td: TensorDictBase) -> None:
        """Add the squared error to the present phase's, and look at the height."""
        phase, after = td["phase"], td["next"]
        sums["square_error"][ids, phase] += after["square_error"].to(sums["square_error"])
        sums["flown"][ids, phase] += 1
        off = (after["pose"][..., UP] - self.goal(after)[..., UP]).abs().to(sums["peak_z"])
        sums["peak_z"][ids] = torch.maximum(sums["peak_z"][ids], off)
        age = td["step"] - td["since"]
        before = torch.where(age == 0, 0.0, sums["calm"][ids])
        calm = torch.where(off < self.band, before + 1, 0.0)
        sums["calm"][ids] = calm
        settle = sums["settle"][ids, phase]
        now = settle.isnan() & (calm == self.hold)
        begun = ((age + 1 - self.hold) * self.dt).to(settle)
        sums["settle"][ids, phase] = torch.where(now, begun, settle)
        sums["lost"][ids] = after["lost"].to(sums["lost"])

    def table(self, env: EnvBase, missions: TensorDictBase, sums: Sums) -> dict[str, Any]:
        square, flown = sums["square_error"], sums["flown"]
        mean = square.sum(1) / flown.sum(1, keepdim=True)
        phases = square.mean(-1) / flown
        numbers = {"mse": mean.mean(-1), "mse_z": mean[:, UP]}
        numbers |= {f"mse_phase_{k}": column for k, column in enumerate(phases.unbind(-1))}
        numbers["peak_z"] = sums["peak_z"]
        later = enumerate(sums["settle"].unbind(-1)[1:], 1)
        numbers |= {f"settle_{k}": column for k, column in later}
        return {**numbers, "steps": sums["steps"].int(), "finished": sums["lost"] == 0}
