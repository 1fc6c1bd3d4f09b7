"""What may look like a fault of the actuators, and is none that can be corrected.

Each is one function of the evidence and of the command that acts now: the effect that it expects.
"""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.correction.linear import Evidence

KEPT = 0.7  # of what readings missed before: 1 if only they are noisy, 0 if nothing of them is
RATED, LEAST_RATE = 12, 0.05  # rows that show a rate; what does not move is not slow
RESTED, WIDEST = 20, 0.2  # rows that show where actuators rest; the band within which they stick
STILL = 0.005  # shares of the largest action: what moves by less rests


def rate_limit(rows: Evidence, acts: Tensor) -> Tensor:
    """Return the effects ``(B, A)`` of actuators with a limited rate.

    That is the fastest of the newest rows. Without two effects nothing is limited.

    >>> one = torch.ones(1, 1, 3)
    >>> rows = Evidence(one, one, torch.tensor([[[0.0, 0.2, 0.3]]]), one, one[..., 0])
    >>> torch.cat([rate_limit(rows, torch.tensor([[x]])) for x in (-1.0, 0.4, 1.0)]).flatten()
    tensor([0.1000, 0.4000, 0.5000])
    """
    came, counts = rows.effect[..., -RATED:], rows.weight[..., -RATED:] > 0
    both = counts[..., 1:] & counts[..., :-1]
    rate = (both * came.diff(dim=-1).abs()).amax(-1).clamp_min(LEAST_RATE)
    now = came[..., -1]
    limited = torch.minimum(torch.maximum(acts, now - rate), now + rate)
    return torch.where(both[..., -1], limited, acts.to(now))


def sensor_noise(rows: Evidence, acts: Tensor) -> Tensor:
    r"""Return the effects ``(B, A)`` that errors of the readings let one expect.

    An error n of a reading is in two effects, :math:`v_k = u_k + n_{k+1} - n_k`. A policy answers
    it, too, so it looks like another gain. Exponential smoothing of the misses foresees it
    (Muth 1960): :math:`-\sum_j \theta^j (v_{k-j} - u_{k-j})`.

    >>> one, missed = torch.ones(1, 1, 2), torch.tensor([[[-0.4, 0.4]]])
    >>> sensor_noise(Evidence(one, 0 * one, missed, one, one[..., 0]), torch.zeros(1, 1))
    tensor([[-0.0840]])
    """
    age = torch.arange(rows.effect.shape[-1], 0, -1, device=acts.device)
    weight = (rows.weight > 0) * (KEPT**age).to(rows.effect)
    return acts + (weight * (rows.acted - rows.effect)).sum(-1)


def stiction(rows: Evidence, acts: Tensor) -> Tensor:
    """Return the effects ``(B, A)`` of actuators that stick.

    One that rests does so until a command is farther from it than any at which it rested before, of
    the newest rows; then it does as commanded.

    >>> one, rests = torch.ones(1, 1, 3), torch.zeros(1, 1, 3)
    >>> rows = Evidence(0.1 * one, 0.1 * one, rests, one, one[..., 0])
    >>> torch.cat([stiction(rows, torch.tensor([[x]])) for x in (0.05, 0.3)]).flatten()
    tensor([0.0000, 0.3000])
    """
    sent, came, weight = (x[..., -RESTED:] for x in (rows.acted, rows.effect, rows.weight))
    counts = weight > 0
    rests = counts[..., 1:] & counts[..., :-1] & (came.diff(dim=-1).abs() < STILL)
    band = (rests * (sent - came).abs()[..., 1:]).amax(-1).clamp_max(WIDEST)
    now = came[..., -1]
    return torch.where((acts - now).abs() <= 1.05 * band, now, acts)
