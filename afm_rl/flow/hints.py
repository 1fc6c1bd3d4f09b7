"""What least squares would do: hints for a flow that reads pairs of actions."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.flow.least_squares import (
    fit_affine,
    fit_friction,
    fit_gain,
    invert_affine,
    invert_friction,
    weigh,
)
from afm_rl.flow.saturation import saturate

SHORT, LONG = 0.5, 0.9  # forgetting: trusts the newest rows, or all of them
FITS = 4
TINY = 1e-3  # half ranges: misses below are all the same


def least_squares_hints(
    executed: Tensor, effective: Tensor, valid: Tensor, planned: Tensor, saturation: str
) -> Tensor:
    r"""Return what four fits of a window would execute, and how badly each explains it.

    The fits: a gain per axis, once with short and once with long memory; a gain with friction
    per axis; an affine map. Each gives an action :math:`u_1`, saturated, and per axis the
    logarithm of the root mean square of what it leaves unexplained, so that a network can tell
    which one to believe. They are exact for what they can express.

    Args:
        executed: u, ``(*B, K, A)``, oldest first.
        effective: what it was worth, ``(*B, K, A)``.
        valid: which pairs count, ``(*B, K, 1)``, 0 or 1.
        planned: the planned action, ``(*B, A)``, all in half ranges.
        saturation: see :func:`~afm_rl.flow.saturation.saturate`.

    Returns:
        ``(*B, 8 A)``.

    >>> u = torch.tensor([[0.5], [-1.0]])
    >>> hints = least_squares_hints(u, -2 * u, torch.ones(2, 1), torch.tensor([0.4]), "clip")
    >>> hints[..., :1].round(decimals=2)
    tensor([-0.2000])
    """
    kind = planned.dtype
    # In double precision: where all commands are alike, gain and friction can hardly be told apart.
    executed, effective, valid, planned = (
        part.double() for part in (executed, effective, valid, planned)
    )
    pairs = executed, effective, valid
    actions: list[Tensor] = []
    misses: list[Tensor] = []

    def add(action: Tensor, explained: Tensor, forgetting: float) -> None:
        weight = weigh(valid, forgetting)
        left = (weight * (effective - explained).square()).sum(-2)
        actions.append(saturate(action, saturation))
        mean = (left / weight.sum(-2).clamp_min(TINY)).clamp_min(0.0)
        misses.append((mean.sqrt() + TINY).log())

    for forgetting in (SHORT, LONG):
        gain = fit_gain(*pairs, forgetting)
        add(planned / gain, gain.unsqueeze(-2) * executed, forgetting)
    gain, offset = fit_friction(*pairs, LONG)
    explained = gain.unsqueeze(-2) * executed + offset.unsqueeze(-2) * executed.sign()
    add(invert_friction(gain, offset, planned), explained, LONG)
    matrix, bias = fit_affine(*pairs, LONG)
    add(invert_affine(matrix, bias, planned), executed @ matrix.mT + bias.unsqueeze(-2), LONG)
    return torch.cat([*actions, *misses], -1).to(kind)
