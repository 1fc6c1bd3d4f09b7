"""Permutation: actuators whose cables were swapped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError
from afm_rl.regimes.base import StaticRegime
from afm_rl.regimes.settings import HalfRange


class Permutation(StaticRegime):
    r"""Each actuator gets the command of another one: :math:`u_{\mathrm{eff}, i} = u_{p_i}`.

    u are actions in half ranges. The parameter of axis i is the index :math:`p_i`; in between, as
    in a ramp, the nearest one holds. The prior draws from all permutations.

    Args:
        names: one parameter name per action axis.
        half_range: half ranges of the action axes.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> swapped = Permutation(["left_from", "right_from"], half_range=[1.0, 2.0])
    >>> row = swapped.encode({"left_from": 1, "right_from": 0})
    >>> swapped.apply(torch.tensor([0.5, 0.2]), row, torch.zeros(3))
    tensor([0.1000, 1.0000])
    """

    def __init__(self, names: Sequence[str], half_range: Sequence[float]) -> None:
        self.half_range = HalfRange(half_range)
        axes = len(self.half_range.values)
        self.names = self.distinct(names, axes)
        self.identity = tuple(float(axis) for axis in range(axes))
        self.limits = dict.fromkeys(self.names, (0.0, axes - 1.0))

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        """Pick each axis from its source."""
        source, ratio = self._sources(action, parameters)
        return action.expand_as(source).gather(-1, source) * ratio

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        """Send each axis to its source."""
        source, ratio = self._sources(effect, parameters)
        command = torch.zeros(source.shape, dtype=effect.dtype, device=effect.device)
        return command.scatter(-1, source, effect / ratio)

    def encode(self, values: Mapping[str, float]) -> Tensor:
        """Return the parameter row ``(A,)``.

        Raises:
            ConfigurationError: also unless the indices are a permutation.
        """
        row = super().encode(values)
        if sorted(row.tolist()) != list(self.identity):
            given = dict(zip(self.names, row.tolist(), strict=True))
            raise ConfigurationError(
                f"regimes: {given}: expected each of 0..{len(self.names) - 1} once"
            )
        return row

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        """Draw permutations ``(*shape, A)``, all equally likely."""
        return torch.rand((*shape, len(self.names)), generator=generator).argsort(-1).float()

    def _sources(self, action: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Return the source of each axis ``(*B, A)``, and its half range per the source's."""
        shape = torch.broadcast_shapes(action.shape, parameters.shape)
        source = parameters.round().long().clamp(0, len(self.names) - 1).expand(shape)
        half = self.half_range.like(action)
        return source, half / half[source]
