"""Missions that follow a reference in time."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from afm_rl.errors import check_number
from afm_rl.missions.score import Score
from afm_rl.storage.measures import Measure, Measures

UP = 2  # index of the z axis


class TrackingScore(Score):
    r"""How far missions were from a reference, and how soon they were back after a change.

    Table: ``mse``, the mean of the squared error over steps and axes (m^2); ``mse_z``, that of
    the z axis; ``mse_phase_k`` in each phase; ``peak_z``, the largest :math:`|e_z|` after a step
    (m); ``settle_k``, the time (s) from the beginning of phase k > 0 to that of the first stretch
    of ``hold`` seconds in which :math:`|e_z|` is below ``band`` after each step; ``steps``;
    ``finished``, whether the mission was not lost. A number that does not exist is NaN.

    Args:
        dt: time of a step (s).
        band: error along z at which a mission counts as settled (m).
        hold: time for which it must stay there (s).

    Raises:
        ConfigurationError: for a setting that cannot be used.
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

    def __init__(self, dt: float, band: float = 0.02, hold: float = 0.2) -> None:
        self.dt = check_number("score.dt", dt, low=0.0, open_low=True)
        self.band = check_number("score.band", band, low=0.0, open_low=True)
        self.hold = max(1, math.ceil(check_number("score.hold", hold, low=0.0) / dt - 1e-6))

    def goal(self, td: TensorDictBase) -> Tensor:
        return td["reference"][..., 0, :3]

    def row(self, td: TensorDictBase) -> Tensor:
        """Return the squared error of the step, per axis, and the phase."""
        square = td["next", "square_error"]
        return torch.cat([square, td["phase"].unsqueeze(-1).to(square)], -1)

    def start(self, missions: TensorDictBase) -> dict[str, Tensor]:
        count, phases = missions["mission", "parameters"].shape[:2]
        return {
            "square_error": torch.zeros(count, phases, 3),
            "flown": torch.zeros(count, phases),
            "peak_z": torch.zeros(count),
            "calm": torch.zeros(count),
            "settle": torch.full((count, phases), math.nan),
            "lost": torch.zeros(count),
        }

    def add(self, sums: dict[str, Tensor], ids: Tensor, td: TensorDictBase) -> None:
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

    def table(
        self, env: EnvBase, missions: TensorDictBase, sums: dict[str, Tensor]
    ) -> dict[str, Any]:
        square, flown = sums["square_error"], sums["flown"]
        mean = square.sum(1) / flown.sum(1, keepdim=True)
        phases = square.mean(-1) / flown
        numbers = {"mse": mean.mean(-1), "mse_z": mean[:, UP]}
        numbers |= {f"mse_phase_{k}": column for k, column in enumerate(phases.unbind(-1))}
        numbers["peak_z"] = sums["peak_z"]
        later = enumerate(sums["settle"].unbind(-1)[1:], 1)
        numbers |= {f"settle_{k}": column for k, column in later}
        return {**numbers, "steps": sums["steps"].int(), "finished": sums["lost"] == 0}
