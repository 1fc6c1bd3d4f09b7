"""What the ground does to actions: wheel slip, patches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import torch
from torch import Tensor

from afm_rl.errors import check_number
from afm_rl.options import Natural, Positive, options
from afm_rl.regimes.base import MOST, HalfRange, Regime, check_span, draw_between
from afm_rl.regimes.gains import MOST_GAIN, GainRegime


class WheelSlip(Regime):
    r"""Traction that peaks at a command c with the value m, the same on all axes.

    .. math:: u_\mathrm{eff} = m\,\frac{u}{c}\,e^{1 - |u| / c}

    c = 0 means no slip, so slip cannot be ramped in.

    Args:
        half_range: half ranges of the action axes, the unit of u, c and m.
        at: lowest and highest c in the prior, uniform.
        peak: lowest and highest m in the prior, uniform.

    >>> slip = WheelSlip(half_range=[1.0, 1.0])
    >>> row = slip.encode({"slip_at": 0.5, "slip_peak": 0.8})
    >>> slip.apply(torch.tensor([0.5, 1.0]), row, torch.zeros(3))
    tensor([0.8000, 0.5886])
    """

    names = ("slip_at", "slip_peak")
    identity = (0.0, 1.0)
    limits = {"slip_at": (0.0, MOST), "slip_peak": (0.0, MOST)}

    def __init__(
        self,
        half_range: Sequence[float],
        at: Sequence[float] = (0.2, 0.8),
        peak: Sequence[float] = (0.3, 0.9),
    ) -> None:
        self.half_range = HalfRange(half_range)
        self.at = check_span("at", at, 0.0, MOST)
        self.peak = check_span("peak", peak, 0.0, MOST)

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        at, peak = parameters[..., :1], parameters[..., 1:]
        grip = at == 0  # the limit of no slip, which the formula does not have
        at = torch.where(grip, 1.0, at)
        load = action / (at * self.half_range.like(action))
        traction = peak / at * (1 - load.abs()).exp()
        return torch.where(grip, action, action * traction)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        """Return the command on the rising side, |u| <= c; at most the peak is achievable."""
        at, peak = parameters[..., :1], parameters[..., 1:]
        half = self.half_range.like(effect)
        most = (peak * half).clamp_min(torch.finfo(effect.dtype).tiny)
        load = rising_load((effect.abs() / most).clamp(max=1.0))
        return torch.where(at == 0, effect, effect.sign() * (at * half) * load)

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        size = (*shape, 1)
        return torch.cat([draw_between(span, size, generator) for span in (self.at, self.peak)], -1)


def rising_load(share: Tensor) -> Tensor:
    r"""Solve :math:`x\,e^{1 - x} = r` for x in [0, 1], given r in [0, 1], any shape.

    :math:`-x` is Lambert's :math:`W_0(-r / e)`. The starting point :math:`1 - q` is a fraction in
    :math:`p = \sqrt{2 (1 - r)}` that agrees with the series about the branch point p = 0 to second
    order and with r = 0. One step of Newton's method on :math:`x - (r / e)\,e^x` leaves an error of
    r below 1e-6.

    >>> rising_load(torch.tensor([0.0, 0.5 * math.exp(0.5), 1.0]))
    tensor([0.0000, 0.5000, 1.0000])
    """
    p = (2 - 2 * share).sqrt()
    q = p / (1 + p * (1 / 3 + (2 * math.sqrt(2) / 3 - 1) / 2 * p))  # q = 1 at r = 0
    k = share * (-q).exp()
    return torch.where(q > 0.05, k * q / (1 - k), 1 - q)  # a step near the peak divides by zero


class Patches(GainRegime):
    r"""A checkerboard of ground; on its odd squares the actions have gains.

    .. math:: a_\mathrm{eff} = g \odot a \quad\text{where}\quad
              \textstyle\sum_i \lfloor s_i / l \rfloor \text{ is odd}

    The prior reverses the first axis, with log-uniform size, and does not change the others.

    Args:
        names: one parameter name per action axis.
        span: smallest and largest size of the first gain in the prior, > 0.

    >>> ground = Patches(size=2.0)
    >>> row = ground.encode({"patch_v_gain": -1.0})
    >>> ground.apply(torch.ones(2), row, torch.tensor([[1.0, 1.0, 0.0], [3.0, 1.0, 0.0]]))
    tensor([[ 1.,  1.],
            [-1.,  1.]])
    """

    by_state = True

    @options("")
    def __init__(
        self,
        size: Annotated[Positive, "side l of the squares, m"] = 2.0,
        where: Annotated[Sequence[Natural], "state coordinates x and y, m"] = (0, 1),
        names: Sequence[str] = ("patch_v_gain", "patch_omega_gain"),
        span: Sequence[float] = (0.5, 1.5),
    ) -> None:
        self.size, self.where = size, list(where)
        self.names = self.distinct(names)
        self.limits = dict.fromkeys(self.names, (-MOST_GAIN, MOST_GAIN))
        self.identity = (1.0,) * len(self.names)
        least = check_number("span", check_span("span", span)[0], low=0.0, open_low=True)
        self.span = math.log(least), math.log(span[1])

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        first = -draw_between(self.span, (*shape, 1), generator).exp()
        return torch.cat([first, torch.ones(*shape, len(self.names) - 1)], -1)

    def gains(self, action: Tensor, parameters: Tensor, *state: Tensor) -> Tensor:
        squares = (state[0][..., self.where] / self.size).floor().sum(-1, keepdim=True)
        return torch.where(squares % 2 == 1, parameters, 1.0)
