"""How well a dynamics model explains transitions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor
from torchrl.objectives import LossModule

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import check_instance
from afm_rl.options import options

Wrap = Annotated[bool, "False: a turn across +-pi counts as 2 pi, as in the published runs"]


def gaussian_nll(mean: Tensor, log_variance: Tensor, target: Tensor, beta: float = 0.0) -> Tensor:
    r"""Return :math:`e^{\beta\ell} ((\mu - y)^2 e^{-\ell} + \ell)`, elementwise.

    Twice the Gaussian negative log-likelihood without its constant, :math:`\ell` the
    log-variance (Chua et al. 2018, eq. 1), times a power of the variance, of which no gradient is
    taken: so means of rows that are hard to predict are not given up (Seitzer et al. 2022, ICLR).

    >>> import torch
    >>> gaussian_nll(torch.zeros(1), torch.zeros(1), torch.full((1,), 3.0))
    tensor([9.])
    """
    loss = (mean - target) ** 2 * (-log_variance).exp() + log_variance
    return loss * (beta * log_variance.detach()).exp() if beta else loss


class GaussianNLLLoss(LossModule):
    """Gaussian negative log-likelihood of the state change under a dynamics model.

    The mean is taken over ensemble members, coordinates and the batch; where :attr:`reduction` is
    "none", each element of the batch has its own. Parameters stay where they are (the loss is not
    functional): planner, transform and optimiser go on sharing one model. ``loss_mask_key`` is
    honoured.

    Args:
        model: any :class:`~afm_rl.dynamics.DynamicsModel`.

    Keys (change them with ``set_keys``): ``state`` ("observation"), ``action`` ("action"),
    ``next_state`` (("next", "observation")).

    >>> import torch
    >>> from tensordict import TensorDict
    >>> from afm_rl.dynamics import Dubins
    >>> loss = GaussianNLLLoss(Dubins())
    >>> s, a = torch.zeros(4, 3), torch.ones(4, 2)
    >>> td = TensorDict({"observation": s, "action": a}, [4])
    >>> loss(td.set(("next", "observation"), Dubins()(s, a)))["loss_nll"]
    tensor(0.)
    """

    @dataclass
    class _AcceptedKeys:
        """Default keys."""

        state: NestedKey = "observation"
        action: NestedKey = "action"
        next_state: NestedKey = ("next", "observation")

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    model: DynamicsModel
    model_params: None
    target_model_params: None
    out_keys = ["loss_nll"]

    @options("loss")
    def __init__(self, model: DynamicsModel, wrap: Wrap = True) -> None:
        self._in_keys: list[NestedKey] | None = None
        super().__init__()
        self.reduction, self.wrap = "mean", wrap
        self.model = check_instance("loss.model", model, DynamicsModel)

    @property
    def functional(self) -> bool:
        """The loss works on the module itself."""
        return False

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries read, in the order of the keys."""
        keys = self.tensor_keys
        return self._in_keys or [keys.state, keys.action, keys.next_state]

    @in_keys.setter
    def in_keys(self, keys: list[NestedKey]) -> None:
        self._in_keys = keys

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        """There is no value estimator."""

    def target(self, state: Tensor, next_state: Tensor) -> Tensor:
        """Return the standardised state change ``(*B, D)``."""
        change = self.model.manifold.difference if self.wrap else torch.sub
        return self.model.standardise(change(next_state, state))

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``loss_nll`` for transitions ``(*L, *N)``."""
        state, action, next_state = (tensordict.get(key) for key in self.in_keys)
        target = self.target(state, next_state).unsqueeze(-2)
        mean, log_variance = self.model.moments(state, action)
        each = gaussian_nll(mean, log_variance, target).mean((-2, -1))
        loss = self._reduce_loss(each, tensordict=tensordict)
        return TensorDict({"loss_nll": loss}, loss.shape)
