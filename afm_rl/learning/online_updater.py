"""Learning by gradients."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.optim import Optimizer

from afm_rl.errors import ConfigurationError, check_flag
from afm_rl.learning.learner import Learner
from afm_rl.learning.nll import GaussianNLLLoss


class OnlineUpdater(Learner):
    """One gradient step on the latest transition, per mission.

    Losses are summed, so with parameters per mission (see ``DynamicsModel.expand_``) every
    mission learns from its own transition only. The optimiser's state per parameter is cut
    when missions finish, if it has the parameter's shape, as Adam's moments have.

    Args:
        loss: the loss to descend.
        optimizer: makes the optimiser of the model's parameters.
        mask_key: boolean entry ``(*B)`` or ``(*B, 1)``: learn here?
        wrap: see :class:`~afm_rl.learning.GaussianNLLLoss`.
    """

    by_gradient = True

    def __init__(
        self,
        loss: GaussianNLLLoss,
        optimizer: Callable[..., Optimizer],
        mask_key: NestedKey | None = None,
        wrap: bool = True,
    ) -> None:
        super().__init__(loss, mask_key)
        loss.wrap = check_flag("updater.wrap", wrap)
        if not any(True for _ in loss.model.parameters()):
            raise ConfigurationError(
                "updater: the dynamics model has nothing to learn; choose dynamics=pe, or "
                "updater=frozen"
            )
        if not callable(optimizer):
            raise ConfigurationError(
                f"updater.optimizer={optimizer!r}: expected a function of parameters, such as "
                "torch.optim.Adam"
            )
        self.optimizer = optimizer(loss.model.parameters())

    def follow(self) -> None:
        """Forget the missions that have left the model, in the optimiser too."""
        known, left = self.readings.missions, getattr(self.loss.model, "missions", None)
        super().follow()
        if left is None or not known.dim() or self.readings.missions is known:
            return
        index = (left.unsqueeze(-1) == known).int().argmax(-1)
        for parameter, state in self.optimizer.state.items():
            for name, value in state.items():
                if isinstance(value, Tensor) and value.shape == (len(known), *parameter.shape[1:]):
                    state[name] = value[index]

    def _learn(self, found: dict[str, Tensor], transitions: TensorDictBase, learn: Tensor) -> None:
        """Take one step."""
        self.optimizer.zero_grad(set_to_none=True)
        torch.where(learn, found["loss"], 0.0).sum().backward()
        self.optimizer.step()
