"""The loss of the universal flow."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.correction.experts import fit_experts
from afm_rl.correction.network import AxisNetwork
from afm_rl.correction.training.prior import Drawn

EFFECT_WEIGHT = 0.6  # of the loss of effects
PRECISION = 0.01  # half ranges: smaller errors count less


def flow_losses(
    network: AxisNetwork, drawn: Drawn, mode: str, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    r"""Return the losses ``(N,)`` of velocity and effect.

    .. math:: \|r\|^2 + 0.5\,|r|_\delta,\ r = v(c, u_0, \tau, x_\tau) - (x_1 - x_0),\qquad
              |r|_\delta,\ r = \hat T(u) - T(u),\qquad
              |r|_\delta = \sqrt{r^2 + \delta^2} - \delta

    with :math:`\delta = 0.01`, :math:`x_\tau = (1 - \tau) x_0 + \tau x_1` (conditional flow
    matching, Lipman et al. 2023; paper, eq. 6), :math:`x_0 = u_0 + 0.3\,\epsilon` around the plan,
    :math:`\epsilon \sim N(0, I)`, and the intended action :math:`x_1 = T^{-1}(u_0)`, both as means
    over plans and axes.
    """
    with torch.no_grad():
        experts = fit_experts(drawn.rows)
    encoded = network.encode(drawn.rows, experts)
    noise = torch.randn(drawn.planned.shape, generator=generator).to(drawn.planned)
    tau = torch.rand(*drawn.planned.shape[:-1], 1, generator=generator).to(noise)
    start = drawn.planned + 0.3 * noise
    point = torch.lerp(start, drawn.intended, tau)
    velocity = network.velocity(network.ask(encoded, drawn.planned, mode), tau, point)
    off = velocity - (drawn.intended - start)
    loss = (off.square() + 0.5 * _size(off)).mean((-2, -1))
    return loss, _size(network.effect(encoded, drawn.probe) - drawn.effect).mean((-2, -1))


def _size(error: Tensor) -> Tensor:
    """Return the size of errors, smooth at zero: it asks for precision where it can be had."""
    return (error.square() + PRECISION**2).sqrt() - PRECISION
