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
GUESSES = FITS + 1  # answers that may be right as they are
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

    gains: Tensor
    """Gains with short and with long memory, ``(*B, 2, A)``."""
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
    trust: Tensor
    """Logarithm of how much they count, ``(*B, K, 1)``."""

    def wide(self) -> Fits:
        """Return the fits with one more dimension, to be asked many questions."""
        flat = {"rub", "friction", "bias", "misses"}
        parts = self._asdict().items()
        return Fits(*(part.unsqueeze(-2 if name in flat else -3) for name, part in parts))

    def execute(self, planned: Tensor, saturation: str) -> Tensor:
        """Return answers ``(*B, 6 A)`` to a plan ``(*B, A)``.

        What each fit would execute, saturated; the action tried whose effect came nearest to the
        plan, and that effect.
        """
        unit = planned.to(self.rub)
        rubbed = invert_friction(self.rub, self.friction, unit)
        affine = invert_affine(self.matrix, self.bias, unit)
        exact = torch.cat([unit.unsqueeze(-2) / self.gains, torch.stack([rubbed, affine], -2)], -2)
        share = self._likeness(self.effective, unit).softmax(-2)
        tried = [(share * part).sum(-2) for part in (self.executed, self.effective)]
        return torch.cat([saturate(exact, saturation).flatten(-2), *tried], -1).to(planned)

    def effect(self, executed: Tensor) -> Tensor:
        """Return answers ``(*B, 6 A)`` about an action ``(*B, A)``.

        What each fit expects it to be worth; what the actions nearest to it were worth, and how
        near they are.
        """
        unit = executed.to(self.rub)
        likeness = self._likeness(self.executed, unit)
        worth = (likeness.softmax(-2) * self.effective).sum(-2)
        nearness = likeness.exp().sum(-2).clamp_max(1.0)
        answers = [*self._expected(unit), worth, nearness]
        return torch.cat(answers, -1).clamp(-LIMIT, LIMIT).to(executed)

    def _likeness(self, among: Tensor, unit: Tensor) -> Tensor:
        """Return how much each pair tells of ``unit`` ``(*B, A)``, logits ``(*B, K, A)``."""
        return self.trust - ((among - unit.unsqueeze(-2)) / NEAR).square()

    def _expected(self, unit: Tensor) -> list[Tensor]:
        """Return what each fit expects ``unit`` ``(*B, A)`` to be worth, ``(*B, A)`` each."""
        gained = [gain * unit for gain in self.gains.unbind(-2)]
        rubbed = apply_friction(self.rub, self.friction, unit)
        axes = zip(self.matrix.unbind(-1), unit.split(1, -1), strict=True)
        affine = sum((column * part for column, part in axes), self.bias)
        return [*gained, rubbed, affine]


def shapes_of(rows: int, size: int) -> list[torch.Size]:
    """Return the shapes of the parts of :class:`Fits`, for K ``rows`` and actions of a size.

    >>> sum(shape.numel() for shape in shapes_of(12, 2))
    82
    """
    one, pairs = (size,), (rows, size)
    shapes = (2, size), one, one, (size, size), one, (FITS * size,), pairs, pairs, (rows, 1)
    return [torch.Size(shape) for shape in shapes]


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
    short, long = weigh(valid, SHORT), weigh(valid, LONG)
    both = torch.stack([short, long], -3)
    fits = Fits(
        fit_gain(executed.unsqueeze(-3), effective.unsqueeze(-3), both),
        *fit_friction(executed, effective, long),
        *fit_affine(executed, effective, long),
        executed,  # until the misses are known
        executed,
        effective,
        long.clamp_min(TINY**2).log(),
    )
    answers = torch.cat(fits.wide()._expected(executed), -1)
    square = (effective.repeat(*[1] * (effective.dim() - 1), FITS) - answers).square()
    share = torch.cat([short, long], -1)
    share = share / share.sum(-2, keepdim=True).clamp_min(TINY)
    early, late = (share.mT @ square).unbind(-2)
    size = executed.shape[-1]
    left = torch.cat([early[..., :size], late[..., size:]], -1)
    misses = (left.clamp_min(0.0).sqrt() + TINY).log()
    return fits._replace(misses=misses.to(kind))
