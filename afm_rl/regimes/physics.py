"""What can change about a body in MuJoCo, beside its actuators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from afm_rl.regimes.base import Regime, check_span, same_command

FACTORS: Mapping[str, tuple[float, float]] = {
    "mass": (0.5, 2.0),
    "friction": (0.2, 1.5),
    "damping": (0.2, 5.0),
    "gravity": (0.8, 1.2),
    "length": (0.8, 1.2),
}
"""Factors, and the ranges from which they are drawn."""
ADDED: Mapping[str, tuple[float, float]] = {
    "payload": (0.0, 0.5),
    "wind_x": (-1.0, 1.0),
    "wind_y": (-1.0, 1.0),
}


class Physics(Regime):
    """Changed physics; actions do not change.

    A world with these parameters moves differently; for MuJoCo see
    :func:`afm_rl.dynamics.mujoco_model.changed_model`. Factors are ``mass``, ``friction``,
    ``damping``, ``gravity`` and ``length`` (of links with constant masses); ``payload`` is a share
    of the whole mass; ``wind_x`` and ``wind_y``, steady accelerations
    (m/s^2).

    Args:
        ranges: lowest and highest value of the parameters that are drawn, by name; all if None.

    >>> heavy = Physics().encode({"mass": 2.0})
    >>> Physics().physics_of(heavy)[0]
    tensor(2.)
    """

    names = (*FACTORS, *ADDED)
    identity = (*[1.0] * len(FACTORS), *[0.0] * len(ADDED))
    limits = {
        **dict.fromkeys(FACTORS, (0.01, 100.0)),
        "gravity": (0.0, 100.0),
        "payload": (0.0, 100.0),
    }
    command_for = same_command

    def __init__(self, ranges: Mapping[str, Sequence[float]] | None = None) -> None:
        super().__init__()
        spans = ranges or {**FACTORS, **ADDED}
        self.check_names(spans)
        self.ranges = {name: check_span(f"robot.physics.{name}", spans[name]) for name in spans}

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        return action.expand(*torch.broadcast_shapes(action.shape[:-1], parameters.shape[:-1]), -1)

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        low, high = torch.tensor(list(self.ranges.values())).unbind(-1)
        drawn = low + (high - low) * torch.rand(*shape, len(low), generator=generator)
        chosen = torch.randint(len(low), (*shape, 1), generator=generator)
        nominal = torch.tensor(self.identity).repeat(*shape, 1)
        column = torch.tensor([self.names.index(name) for name in self.ranges])[chosen]
        return nominal.scatter(-1, column, drawn.gather(-1, chosen))

    def physics_of(self, parameters: Tensor) -> Tensor:
        return parameters
