r"""Regimes without a robot: what the universal flow is trained on.

An action u in half ranges has the effect

.. math:: T(u) = M\,\phi(u) + b

with a scalar map :math:`\phi_a` per axis (gains, dead zone, saturation, slip, asymmetry, smooth
distortion, quantisation; tabulated), a mixing matrix M (rotation, permutation, coupling) and a
bias b.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.correction.achievable import LEAST, LIMIT
from afm_rl.correction.experts import Rows

GRID = 257  # points of a tabulated map
KINDS = {  # share of each kind of scalar map among the regimes
    "linear": 0.52,
    "slip": 0.17,
    "dead_zone": 0.12,
    "saturation": 0.05,
    "asymmetry": 0.04,
    "distortion": 0.07,
    "quantisation": 0.03,
}
MIXES = {  # share of each kind of mixing matrix, for two axes or more
    "none": 0.72,
    "rotation": 0.10,
    "permutation": 0.08,
    "coupling": 0.10,
}


class Maps(NamedTuple):
    """N regimes of A axes."""

    table: Tensor
    """Scalar maps at the points of the grid over [-1, 1], ``(N, A, G)``."""
    matrix: Tensor
    """M, ``(N, A, A)``."""
    bias: Tensor
    """b, ``(N, A)``."""

    def scalar(self, unit: Tensor) -> Tensor:
        r"""Return :math:`\phi(u)` for actions ``(N, *C, A)``, by linear interpolation."""
        flat = unit.reshape(len(self.table), -1, unit.shape[-1]).mT  # (N, A, C)
        at = (flat + 1) * (0.5 * (GRID - 1))
        below = at.floor().clamp(0, GRID - 2)
        low = self.table.gather(-1, below.long())
        high = self.table.gather(-1, below.long() + 1)
        return torch.lerp(low, high, at - below).mT.reshape(unit.shape)

    def effect(self, unit: Tensor) -> Tensor:
        """Return T(u) for actions ``(N, *C, A)`` in [-1, 1]."""
        wide = (len(self.table), *[1] * (unit.dim() - 2))
        mixed = self.matrix.view(*wide, *self.matrix.shape[-2:]) @ self.scalar(unit).unsqueeze(-1)
        return mixed.squeeze(-1) + self.bias.view(*wide, -1)

    def inverse(self, planned: Tensor, mode: str) -> Tensor:
        """Return the actions ``(N, C, A)`` in [-1, 1] for planned effects ``(N, C, A)``.

        What is out of reach is saturated: as much of its direction as there is (``"direction"``),
        every axis as far as it goes (``"clip"``), or the first of both only where less than 15 %
        can be had (``"mixed"``).
        """
        bias = self.bias.unsqueeze(-2)
        still = torch.linalg.solve(self.matrix, -bias.mT).mT
        whole = torch.linalg.solve(self.matrix, (planned - bias).mT).mT
        low, high = self.table.amin(-1).unsqueeze(-2), self.table.amax(-1).unsqueeze(-2)
        ahead = whole - still
        room = torch.where(ahead > 0, high - still, still - low)
        share = (room / ahead.abs().clamp_min(1e-9)).amin(-1, keepdim=True).clamp(0.0, 1.0)
        if mode == "clip":
            share = torch.ones_like(share)
        elif mode == "mixed":
            share = torch.where((share > LEAST) | (share == 0.0), 1.0, share)
        else:
            share = torch.where(share == 0.0, 1.0, share)
        wanted = (still + share * ahead).clamp(low, high)
        return _invert(self.table.unsqueeze(-3), wanted)


def _invert(table: Tensor, wanted: Tensor) -> Tensor:
    """Return the smallest u ``(N, C, A)`` whose tabulated value is ``wanted``, the same shape."""
    grid = torch.linspace(-1.0, 1.0, GRID)
    miss = table - wanted.unsqueeze(-1)
    left, right = miss[..., :-1], miss[..., 1:]
    slope = left - right
    part = torch.where(slope == 0.0, 0.0, left / torch.where(slope == 0.0, 1.0, slope))
    crossing = grid[:-1] + part * (grid[1] - grid[0])
    found = left * right <= 0.0
    best = torch.where(found, crossing.abs(), torch.inf).min(-1)
    exact = crossing.gather(-1, best.indices.unsqueeze(-1)).squeeze(-1)
    nearest = grid[(miss.abs() + 1e-4 * grid.abs()).argmin(-1)]
    return torch.where(best.values.isfinite(), exact, nearest).clamp(-1.0, 1.0)


class Draw:
    """Random numbers of one generator, in the shapes that are needed here.

    Args:
        generator: of the numbers.
    """

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=self.generator)

    def log_uniform(self, low: float, high: float, *shape: int) -> Tensor:
        return self.uniform(math.log(low), math.log(high), *shape).exp()

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator)

    def chance(self, share: float, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.generator) < share

    def choice(self, shares: Mapping[str, float], names: Iterable[str], count: int) -> Tensor:
        weights = torch.tensor([shares.get(name, 0.0) for name in names])
        return torch.multinomial(weights, count, replacement=True, generator=self.generator)


def draw_maps(
    count: int,
    axes: int,
    draw: Draw,
    kinds: Mapping[str, float] = KINDS,
    mixes: Mapping[str, float] = MIXES,
) -> Maps:
    """Draw N regimes of A axes; one in twelve is nominal."""
    table = _draw_tables(count, axes, draw, kinds)
    gain = draw.log_uniform(0.03, 3.0, count, axes) * torch.where(
        draw.chance(0.5, count, axes), 1.0, -1.0
    )
    gain = torch.where(draw.chance(0.25, count, axes) | draw.chance(0.1, count, 1), 1.0, gain)
    matrix = _draw_matrices(count, axes, draw, mixes)
    bias = draw.uniform(-0.5, 0.5, count, axes) * draw.chance(0.15, count, 1)
    # A fault of a few axes only is as frequent as one of all.
    touched = draw.chance(0.6, count, 1) | draw.chance(1.5 / (axes + 0.5), count, axes)
    touched &= ~draw.chance(1 / 12, count, 1)
    grid = torch.linspace(-1.0, 1.0, GRID)
    table = torch.where(touched.unsqueeze(-1), table, grid)
    gain, bias = torch.where(touched, gain, 1.0), torch.where(touched, bias, 0.0)
    alone = (touched.unsqueeze(-1) & touched.unsqueeze(-2)).all(-1, keepdim=True)
    matrix = torch.where(alone.all(-2, keepdim=True), matrix, torch.eye(axes))
    return Maps(table, gain.unsqueeze(-1) * matrix, bias)


def _draw_tables(count: int, axes: int, draw: Draw, kinds: Mapping[str, float]) -> Tensor:
    """Draw scalar maps ``(N, A, G)``; the parameters are the same on all axes in half of them."""
    grid = torch.linspace(-1.0, 1.0, GRID)

    def parameter(low: float, high: float) -> Tensor:
        own = draw.uniform(low, high, count, axes)
        return torch.where(draw.chance(0.5, count, 1), own[:, :1], own).unsqueeze(-1)

    kind = draw.choice(kinds, KINDS, count).view(-1, 1, 1)
    at, size = parameter(0.2, 0.8), grid.abs()
    forward, backward = parameter(-1.2, 0.4).exp(), parameter(-1.2, 0.4).exp()
    once, twice = (
        parameter(-0.25, 0.25) * (math.pi * k * grid + parameter(-math.pi, math.pi)).sin()
        for k in (1, 2)
    )
    waves = once + twice
    levels = parameter(2.0, 16.0).round()
    tables = [
        grid.expand(count, axes, GRID),
        parameter(0.3, 0.9) * grid / at * (1 - size / at).exp(),
        grid.sign() * (size - parameter(0.05, 0.6)).clamp_min(0.0),
        torch.minimum(size, parameter(0.2, 0.7)) * grid.sign(),
        grid * torch.where(grid > 0, forward, backward),
        grid + waves - (waves[..., GRID // 2 : GRID // 2 + 1]),
        (grid * levels).round() / levels,
    ]
    return torch.stack(tables).gather(0, kind.expand(count, axes, GRID).unsqueeze(0)).squeeze(0)


def _draw_matrices(count: int, axes: int, draw: Draw, mixes: Mapping[str, float]) -> Tensor:
    """Draw mixing matrices ``(N, A, A)``."""
    eye = torch.eye(axes).expand(count, axes, axes)
    if axes == 1:
        return eye
    kind = draw.choice(mixes, MIXES, count).view(-1, 1, 1)
    order = torch.rand(count, axes, generator=draw.generator).argsort(-1)
    swapped = torch.where(  # two axes only, or any order
        draw.chance(0.5, count, 1), order, _swap_two(order)
    )
    permutation = eye.gather(-2, swapped.unsqueeze(-1).expand_as(eye))
    angle = draw.uniform(-math.pi, math.pi, count, 1, 1)
    first, second = (eye.gather(-2, order[:, k].view(-1, 1, 1).expand(-1, 1, axes)) for k in (0, 1))
    plane = first.mT @ first + second.mT @ second
    turn = second.mT @ first - first.mT @ second
    rotation = eye + (angle.cos() - 1) * plane + angle.sin() * turn
    coupling = eye + draw.log_uniform(0.02, 0.6, count, 1, 1) * draw.normal(count, axes, axes) / (
        math.sqrt(axes)
    )
    matrices = torch.stack([eye, rotation, permutation, coupling])
    chosen = matrices.gather(0, kind.expand_as(eye).unsqueeze(0)).squeeze(0)
    sound = torch.linalg.cond(chosen) < 10.0
    return torch.where(sound.view(-1, 1, 1), chosen, eye)


def _swap_two(order: Tensor) -> Tensor:
    """Return permutations ``(N, A)`` that exchange two axes, drawn from orders ``(N, A)``."""
    swapped = torch.arange(order.shape[-1]).expand_as(order).clone()
    return swapped.scatter_(-1, order[:, :2], order[:, :2].flip(-1))


class Drawn(NamedTuple):
    """Training examples of the universal flow, in half ranges."""

    rows: Rows
    """What describes the regime, ``(N, K, A)``."""
    planned: Tensor
    """C plans, ``(N, C, A)``."""
    intended: Tensor
    """The actions that have the planned effects, ``(N, C, A)``."""
    probe: Tensor
    """Some other actions, ``(N, C, A)``."""
    effect: Tensor
    """Their effects, ``(N, C, A)``."""


def draw_examples(
    count: int,
    axes: int,
    rows: int,
    plans: int,
    mode: str,
    generator: torch.Generator,
    kinds: Mapping[str, float] = KINDS,
    mixes: Mapping[str, float] = MIXES,
    drifting: float = 0.2,
) -> Drawn:
    """Draw regimes, the windows that a robot would have seen under them, plans and answers.

    Half of the windows hold an older regime as well. Actions fill the box, keep near one action,
    stay at a limit, or do not change at all. Effects are noisy by an amount that is known, under-
    or overstated; some are outliers, some axes of some rows tell nothing, and in some windows a
    force adds to them that drifts.

    Args:
        count: windows, N.
        axes: number of actions, A.
        rows: of a window, K.
        plans: for each window, C.
        mode: how plans that cannot be had are saturated.
        generator: of all that is drawn.
        kinds: shares of the kinds of scalar maps of the present regimes.
        mixes: shares of their kinds of mixing matrices.
        drifting: share of the windows with a force that drifts.
    """
    draw = Draw(generator)
    now, before = draw_maps(count, axes, draw, kinds, mixes), draw_maps(count, axes, draw)
    executed = draw_actions(count, rows, axes, draw)
    fresh, valid = draw_masks(count, rows, draw)
    now, earlier = _disturb(now, executed, drifting, draw)
    effective = now.effect(executed) + earlier
    effective = torch.where(fresh == 1.0, effective, before.effect(executed))
    flicker = draw.uniform(0.1, 0.5, count, 1, 1) * draw.chance(0.06, count, 1, 1)
    effective = effective * (1 + flicker * draw.normal(count, rows, axes))
    std = draw.log_uniform(1e-5, 0.3, count, 1, 1) * draw.log_uniform(0.3, 3.0, count, 1, axes)
    mute = draw.chance(0.2, count, 1, 1) & draw.chance(0.3, count, rows, axes)
    std = torch.where(mute, draw.log_uniform(0.3, LIMIT, count, rows, axes), std)
    noise = std * draw.normal(count, rows, axes)
    wild = draw.chance(0.12, count, 1, 1) & draw.chance(0.08, count, rows, axes)
    noise = noise + wild * 0.5 * draw.normal(count, rows, axes)
    # A transition that shows nothing leaves the action where it was.
    effective = torch.where(mute, torch.lerp(effective, executed, 0.5), effective) + noise
    told = std * draw.log_uniform(0.5, 2.0, count, 1, 1)
    # What a model states of its noise is often an upper bound, and at times too little; what is
    # learnt of it is added, and has a floor.
    modest, bold = draw.chance(0.35, count, 1, 1), draw.chance(0.25, count, 1, 1)
    told = told * torch.where(modest, draw.log_uniform(1.0, 100.0, count, 1, 1), 1.0)
    told = told * torch.where(bold & ~modest, draw.log_uniform(0.1, 1.0, count, 1, 1), 1.0)
    told = torch.hypot(told, draw.log_uniform(0.02, 0.1, count, 1, 1)).clamp_max(LIMIT)
    seen = Rows(executed, effective.clamp(-LIMIT, LIMIT), told, valid)
    planned = _draw_plans(now, executed[:, -1:], plans, draw)
    probe = draw.uniform(-1.0, 1.0, count, plans, axes)
    return Drawn(
        Rows(*(part * valid for part in seen)),
        planned,
        now.inverse(planned, mode),
        probe,
        now.effect(probe).clamp(-LIMIT, LIMIT),
    )


def _disturb(now: Maps, executed: Tensor, share: float, draw: Draw) -> tuple[Maps, Tensor]:
    """Add forces that drift to a share of the windows: gravity, wind, gusts, friction.

    A force that grows with the speed follows the commands as a low-pass filter does. Where there is
    one, the actuators are mostly healthy.

    Returns:
        The regimes with the newest force as their bias, and how much the force of every row was
        above that, ``(N, K, A)``.
    """
    count, rows, axes = executed.shape
    age = torch.arange(rows - 1, -1, -1.0).view(1, -1, 1)
    steps = draw.normal(count, rows, axes) / math.sqrt(rows)
    drift = draw.normal(count, 1, axes) + draw.normal(count, 1, axes) * age / rows
    drift = draw.log_uniform(0.03, 1.0, count, 1, 1) * (drift + 0.5 * steps.cumsum(-2))
    keep = (-1 / draw.log_uniform(0.7, 8.0, count, 1, 1)).exp()
    past = (age.squeeze(-1) - age.squeeze(-1).mT).neg()  # (1, K, K): rows before a row
    weights = torch.where(past >= 0, keep ** past.clamp_min(0) * (1 - keep), 0.0)
    speed = weights @ executed + keep ** (rows - age) * executed[:, :1]
    friction = -draw.uniform(0.0, 1.3, count, 1, axes) * speed
    force = torch.where(draw.chance(0.4, count, 1, 1), friction, drift)
    force = force * (draw.chance(share, count, 1, 1) & draw.chance(0.7, count, 1, axes))
    moved = (force != 0.0).any(-2).any(-1).view(-1, 1, 1) & draw.chance(0.75, count, 1, 1)
    grid, eye = torch.linspace(-1.0, 1.0, GRID), torch.eye(axes)
    bias = torch.where(moved.squeeze(-1), 0.0, now.bias) + force[:, -1]
    table, matrix = torch.where(moved, grid, now.table), torch.where(moved, eye, now.matrix)
    return Maps(table, matrix, bias), force - force[:, -1:]


def draw_actions(count: int, rows: int, axes: int, draw: Draw) -> Tensor:
    """Draw executed actions ``(N, K, A)``.

    36 % of the windows keep near one action, 9 % do not change it at all, and 5 % jump between the
    limits.
    """
    wide = draw.uniform(-1.0, 1.0, count, rows, axes)
    # Centres of narrow windows are drawn in a larger box and cut: many actions saturate.
    around = 1.6 * draw.uniform(-1.0, 1.0, count, 1, axes)
    spread = draw.log_uniform(0.01, 0.6, count, 1, axes) * draw.chance(0.8, count, 1, 1)
    wide = torch.where(draw.chance(1 / 12, count, 1, 1), wide.sign(), wide)
    return torch.where(draw.chance(0.55, count, 1, 1), wide, (around + spread * wide).clamp(-1, 1))


def draw_masks(count: int, rows: int, draw: Draw) -> tuple[Tensor, Tensor]:
    """Draw which rows are of the present regime, and which are filled, ``(N, K, 1)`` each."""
    row = torch.arange(rows).view(1, -1, 1)

    def some() -> Tensor:
        return torch.randint(1, rows + 1, (count, 1, 1), generator=draw.generator)

    fresh = row >= rows - torch.where(draw.chance(0.5, count, 1, 1), rows, some())
    usual = torch.tensor([max(1, rows // share) for share in (12, 6, 2, 1)])
    filled = usual[torch.randint(4, (count, 1, 1), generator=draw.generator)]
    filled = torch.where(draw.chance(0.25, count, 1, 1), some(), filled)
    return fresh.float(), (row >= rows - filled).float()


def _draw_plans(now: Maps, last: Tensor, plans: int, draw: Draw) -> Tensor:
    """Draw plans ``(N, C, A)``: anywhere, effects that can be had, or near the last effect."""
    count, _, axes = last.shape
    size = (count, plans)
    kind = torch.rand(*size, 1, generator=draw.generator)
    anywhere = draw.uniform(-1.0, 1.0, *size, axes)
    achievable = now.effect(draw.uniform(-1.0, 1.0, *size, axes))
    near = now.effect(last) + draw.log_uniform(0.01, 0.3, *size, 1) * draw.normal(*size, axes)
    near = torch.where(draw.chance(0.25, *size, 1), -near, near)
    plan = torch.where(kind < 0.4, anywhere, torch.where(kind < 0.65, achievable, near))
    return plan.clamp(-2.0, 2.0)
