"""Commands that arrive as others: cut, lost, rounded, swapped, turned."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError
from afm_rl.regimes.base import HalfRange, HalfRangeRegime, Regime


class Saturation(HalfRangeRegime):
    r"""Commands cut at a fraction of the half range, the same on all axes; 1 cuts nothing.

    .. math:: u_\mathrm{eff} = \mathrm{clamp}(u, -s, s)

    Args:
        half_range: half ranges of the action axes, the unit of u.
        span: lowest and highest fraction s in the prior, uniform.

    >>> weak = Saturation(half_range=[1.0, 2.0])
    >>> weak.apply(torch.tensor([-0.9, 0.6]), weak.encode({"saturation": 0.5}), torch.zeros(3))
    tensor([-0.5000,  0.6000])
    """

    names = ("saturation",)
    identity = (1.0,)
    limits = {"saturation": (0.01, 1.0)}  # 0 would leave nothing to command
    span = (0.2, 0.6)

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        most = torch.where(parameters < 1.0, parameters, torch.inf) * self.half_range.like(action)
        return action.clamp(-most, most)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        """Return the smallest command with the nearest effect: the effect, cut alike."""
        return self.effect_of(effect, parameters)


class DeadZone(HalfRangeRegime):
    r"""A loss that has to be overcome first, the same on all axes; 0 loses nothing.

    .. math:: u_\mathrm{eff} = \mathrm{sign}(u) \max(|u| - d, 0)

    Args:
        half_range: half ranges of the action axes, the unit of u.
        span: lowest and highest d in the prior, uniform.

    >>> import torch
    >>> stiff = DeadZone(half_range=[1.0, 2.0])
    >>> stiff.apply(torch.tensor([-0.2, 1.0]), stiff.encode({"dead_zone": 0.25}), torch.zeros(3))
    tensor([-0.0000, 0.5000])
    """

    names = ("dead_zone",)
    identity = (0.0,)
    limits = {"dead_zone": (0.0, 1.0)}
    span = (0.1, 0.6)

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        loss = parameters * self.half_range.like(action)
        return action.sign() * (action.abs() - loss).clamp(min=0.0)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        """Add the loss; the command for no effect is zero."""
        loss = parameters * self.half_range.like(effect)
        return effect + effect.sign() * loss


class Quantisation(HalfRangeRegime):
    r"""Commands rounded to multiples of a step q, the same on all axes; 0 rounds nothing.

    .. math:: u_\mathrm{eff} = q\,\mathrm{round}(u / q)

    Args:
        half_range: half ranges of the action axes, the unit of u and q.
        span: lowest and highest step q in the prior, uniform.

    >>> coarse = Quantisation(half_range=[1.0, 2.0])
    >>> coarse.apply(torch.tensor([0.3, 0.3]), coarse.encode({"quantum": 0.5}), torch.zeros(3))
    tensor([0.5000, 0.0000])
    """

    names = ("quantum",)
    identity = (0.0,)
    limits = {"quantum": (0.0, 1.0)}
    span = (0.1, 0.5)

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        step = parameters * self.half_range.like(action)
        fine = step == 0
        step = torch.where(fine, 1.0, step)
        return torch.where(fine, action, (action / step).round() * step)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        """Return the nearest position, or the end of the box that is nearest to it."""
        return self.effect_of(effect, parameters)


class Permutation(Regime):
    r"""Each actuator gets the command of another one: :math:`u_{\mathrm{eff}, i} = u_{p_i}`.

    u are actions in half ranges. The parameter of axis i is the index :math:`p_i`; in between, as
    in a ramp, the nearest one holds. The prior draws from all permutations.

    Args:
        names: one parameter name per action axis.
        half_range: half ranges of the action axes.

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
        source, ratio = self._sources(action, parameters)
        return action.expand_as(source).gather(-1, source) * ratio

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        source, ratio = self._sources(effect, parameters)
        command = torch.zeros(source.shape, dtype=effect.dtype, device=effect.device)
        return command.scatter(-1, source, effect / ratio)

    def encode(self, values: Mapping[str, float]) -> Tensor:
        """Return the parameter row ``(A,)``, if its indices are a permutation."""
        row = super().encode(values)
        if sorted(row.tolist()) != list(self.identity):
            given = dict(zip(self.names, row.tolist(), strict=True))
            raise ConfigurationError(
                f"regimes: {given}: expected each of 0..{len(self.names) - 1} once"
            )
        return row

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        return torch.rand((*shape, len(self.names)), generator=generator).argsort(-1).float()

    def _sources(self, action: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Return the source of each axis ``(*B, A)``, and its half range per the source's."""
        shape = torch.broadcast_shapes(action.shape, parameters.shape)
        source = parameters.round().long().clamp(0, len(self.names) - 1).expand(shape)
        half = self.half_range.like(action)
        return source, half / half[source]


class Rotation(HalfRangeRegime):
    r"""The action, in half ranges, turned by an angle: :math:`u_\mathrm{eff} = R(\phi)\,u`.

    Args:
        half_range: half ranges of the two action axes.
        span: lowest and highest angle (rad) in the prior, uniform.

    >>> coupling = Rotation(half_range=[1.0, 2.0])
    >>> row = coupling.encode({"rotation": math.pi / 2})
    >>> coupling.apply(torch.tensor([0.5, 0.0]), row, torch.zeros(3)).round(decimals=4)
    tensor([-0., 1.])
    """

    names = ("rotation",)
    identity = (0.0,)
    limits = {"rotation": (-2 * math.pi, 2 * math.pi)}
    span = (-math.pi, math.pi)

    def __init__(self, half_range: Sequence[float], span: Sequence[float] | None = None) -> None:
        super().__init__(half_range, span)
        if len(self.half_range.values) != 2:
            raise ConfigurationError(f"half_range={half_range!r}: expected two action axes")

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        return self._turned(action, parameters)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        """Rotate back; not the nearest effect where that does not fit the box."""
        return self._turned(effect, -parameters)

    def _turned(self, action: Tensor, angle: Tensor) -> Tensor:
        # The half ranges stand in the matrix: at angle 0 the action is kept to the bit.
        first, second = self.half_range.values
        cos, sin = angle.squeeze(-1).cos(), angle.squeeze(-1).sin()
        x, y = action.unbind(-1)
        across = x * cos - y * sin * (first / second)
        return torch.stack([across, x * sin * (second / first) + y * cos], -1)
