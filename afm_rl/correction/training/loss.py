"""The loss of the universal flow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor

from afm_rl.correction.achievable import Saturation
from afm_rl.correction.experts import Rows, fit_experts
from afm_rl.correction.network import AxisNetwork
from afm_rl.correction.training.prior import Drawn
from afm_rl.errors import check_instance
from afm_rl.learning import InPlaceLoss
from afm_rl.options import Natural, options

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


class CFMLoss(InPlaceLoss):
    """The loss of :func:`flow_losses` as a TorchRL loss module.

    Args:
        network: the network to train.
        saturation: mode of the intended actions.
        seed: of the times and starting points.

    Keys (change them with ``set_keys``): ``executed``, ``effective``, ``std`` ``(*B, K, A)`` and
    ``valid`` ``(*B, K, 1)`` describe the regime; ``planned``, ``intended``, ``probe`` and
    ``effect`` ``(*B, C, A)`` are asked and known. All in half ranges.
    """

    @dataclass
    class _AcceptedKeys:
        """Default keys."""

        executed: NestedKey = "executed"
        effective: NestedKey = "effective"
        std: NestedKey = "std"
        valid: NestedKey = "valid"
        planned: NestedKey = "planned"
        intended: NestedKey = "intended"
        probe: NestedKey = "probe"
        effect: NestedKey = "effect"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    network: AxisNetwork
    network_params: None
    target_network_params: None
    out_keys = ["loss_cfm"]

    @options("loss")
    def __init__(
        self,
        network: AxisNetwork,
        saturation: Saturation = "mixed",
        seed: Annotated[Natural, "of the points on the paths"] = 0,
    ) -> None:
        super().__init__()
        self.network = check_instance("loss.network", network, AxisNetwork)
        self.saturation = saturation
        self._generator = torch.Generator().manual_seed(seed)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``loss_cfm`` for examples ``(*B)``."""
        parts = [tensordict.get(key) for key in self.in_keys]
        batch = parts[0].shape[:-2]
        parts = [part.reshape(-1, *part.shape[-2:]) for part in parts]
        drawn = Drawn(Rows(*parts[:4]), *parts[4:])
        velocity, effect = flow_losses(self.network, drawn, self.saturation, self._generator)
        return self._reduced((velocity + EFFECT_WEIGHT * effect).view(batch), tensordict)
