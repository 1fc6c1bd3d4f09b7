"""Correctors of points in some dimensions, and what becomes of the commands ``(*B, A)`` so far."""

import torch

from afm_rl.correction import ActionFlow


def flow_of(size, **settings):
    """Return a corrector of actions between -1 and 1."""
    return ActionFlow(-torch.ones(size), torch.ones(size), **settings)


def before(sent, steps):
    """Return the commands some steps before the newest, zeros at first."""
    return sent[-1 - steps] if len(sent) > steps else torch.zeros_like(sent[-1])


def half_reversed(sent):
    """Reverse the first, third, ... axis."""
    axis = torch.arange(sent[-1].shape[-1])
    return -((-1.0) ** axis) * sent[-1]


EFFECTS = {
    "healthy": lambda sent: sent[-1],
    "reversed": lambda sent: -sent[-1],
    "half": lambda sent: 0.5 * sent[-1],
    "offset": lambda sent: sent[-1] + 0.2,
    "two steps late": lambda sent: before(sent, 2),
    "reversed and late": lambda sent: -before(sent, 2),
    "lag": lambda sent: sum(0.6 * 0.4**k * before(sent, k) for k in range(5)),
    "first reversed": lambda sent: torch.cat([-sent[-1][:, :1], sent[-1][:, 1:]], -1),
    "swapped": lambda sent: sent[-1].flip(-1),
    "dead": lambda sent: 0 * sent[-1],
    "dead zone": lambda sent: torch.where(sent[-1].abs() < 0.2, 0 * sent[-1], -sent[-1]),
}
