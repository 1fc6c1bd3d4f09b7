"""What least squares and the nearest pairs make of a window: hints for a context flow."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.flow.least_squares import (
    apply_friction,
    fit_affine,
    fit_friction,
    fit_gain,
    invert_affine,
    invert_friction,
    weigh,
)
from afm_rl.flow.saturation import LIMIT, saturate

SHORT, LONG = 0.5, 0.9  # forgetting: trusts the newest rows, or all of them
NEAR = 0.15  # half ranges: pairs so far from what is asked tell half as much as it does itself
FITS = 4
ANSWERS, MISSES = FITS + 2, FITS  # hints per axis: what is answered, and how well the fits fit
TINY = 1e-3  # half ranges: misses below are all the same


class Fits(NamedTuple):
    """Four least-squares fits of a window, exact for what they can express, and its pairs.

    A gain per axis, once with short and once with long memory; a gain with friction per axis;
    an affine map. What none of them can express is answered from the pairs nearest to what is
    asked, each axis for itself.

    >>> u = torch.tensor([[0.5], [-1.0]])
    >>> fits = fit_window(u, -2 * u, torch.ones(2, 1))
    >>> fits.execute(torch.tensor([0.4]), "clip")[..., :1].round(decimals=2)
    tensor([-0.2000])
    >>> fits.effect(torch.tensor([0.4]))[..., :1].round(decimals=2)
    tensor([-0.8000])
    """

    quick: Tensor
    """Gain with short memory, ``(*B, A)``."""
    slow: Tensor
    """Gain with long memory, ``(*B, A)``."""
    rub: Tensor
    """Gain beside friction, ``(*B, A)``."""
    friction: Tensor
    """Offset against the motion, ``(*B, A)``."""
    matrix: Tensor
    """Of the affine map, ``(*B, A, A)``."""
    bias: Tensor
    """Of the affine map, ``(*B, A)``."""
    misses: Tensor
    """Logarithm of the root mean square that each leaves unexplained, ``(*B, 4 A)``."""
    executed: Tensor
    """Executed actions of the window, ``(*B, K, A)``."""
    effective: Tensor
    """What they were worth, ``(*B, K, A)``."""
    weight: Tensor
    """How much they count, ``(*B, K, 1)``."""

    def wide(self) -> Fits:
        """Return the fits with one more dimension, to be asked many questions."""
        tall = {"matrix", "executed", "effective", "weight"}
        parts = self._asdict().items()
        return Fits(*(part.unsqueeze(-3 if name in tall else -2) for name, part in parts))

    def execute(self, planned: Tensor, saturation: str) -> Tensor:
        """Return answers ``(*B, 6 A)`` to a plan ``(*B, A)``.

        What each fit would execute, saturated; the action tried whose effect came nearest to the
        plan, and that effect.
        """
        unit = planned.double()
        wanted = [
            unit / self.quick,
            unit / self.slow,
            invert_friction(self.rub, self.friction, unit),
            invert_affine(self.matrix, self.bias, unit),
        ]
        answers = [saturate(action, saturation) for action in wanted]
        answers += self._nearest(self.effective, unit)[:2]
        return torch.cat(answers, -1).to(planned)

    def effect(self, executed: Tensor) -> Tensor:
        """Return answers ``(*B, 6 A)`` about an action ``(*B, A)``.

        What each fit expects it to be worth; what the actions nearest to it were worth, and how
        near they are.
        """
        unit = executed.double()
        _, worth, nearness = self._nearest(self.executed, unit)
        answers = [*self._effects(unit), worth, nearness]
        return torch.cat(answers, -1).clamp(-LIMIT, LIMIT).to(executed)

    def _nearest(self, among: Tensor, unit: Tensor) -> list[Tensor]:
        """Return means ``(*B, A)`` of the pairs nearest to ``unit`` on each axis, and nearness."""
        apart = ((among - unit.unsqueeze(-2)) / NEAR).square()
        score = self.weight.clamp_min(TINY**2).log() - apart
        share = score.softmax(-2)
        means = [(share * part).sum(-2) for part in (self.executed, self.effective)]
        return [*means, score.logsumexp(-2).exp().clamp_max(1.0)]

    def _effects(self, unit: Tensor) -> list[Tensor]:
        affine = (self.matrix @ unit.unsqueeze(-1)).squeeze(-1) + self.bias
        rubbed = apply_friction(self.rub, self.friction, unit)
        return [self.quick * unit, self.slow * unit, rubbed, affine]


def fit_window(executed: Tensor, effective: Tensor, valid: Tensor) -> Fits:
    """Fit a window.

    Args:
        executed: u, ``(*B, K, A)``, oldest first.
        effective: what it was worth, ``(*B, K, A)``.
        valid: which pairs count, ``(*B, K, 1)``, 0 or 1.
    """
    kind = executed.dtype
    # In double precision: where all commands are alike, gain and friction can hardly be told apart.
    executed, effective, valid = (part.double() for part in (executed, effective, valid))
    pairs = executed, effective, valid
    fits = Fits(
        fit_gain(*pairs, SHORT),
        fit_gain(*pairs, LONG),
        *fit_friction(*pairs, LONG),
        *fit_affine(*pairs, LONG),
        executed,  # until the misses are known
        executed,
        effective,
        weigh(valid, LONG),
    )
    weights = (weigh(valid, forgetting) for forgetting in (SHORT, LONG, LONG, LONG))
    misses = []
    for explained, weight in zip(fits.wide()._effects(executed), weights, strict=True):
        left = (weight * (effective - explained).square()).sum(-2)
        mean = (left / weight.sum(-2).clamp_min(TINY)).clamp_min(0.0)
        misses.append((mean.sqrt() + TINY).log())
    return fits._replace(misses=torch.cat(misses, -1).to(kind))
