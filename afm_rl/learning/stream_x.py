"""Learning from a stream, one transition at a time, without overshooting."""

from __future__ import annotations

from functools import partial
from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from afm_rl.dynamics import Ensemble
from afm_rl.errors import ConfigurationError, check_choice
from afm_rl.learning.nll import GaussianNLLLoss, gaussian_nll
from afm_rl.learning.obgd import ObGD
from afm_rl.learning.online_updater import OnlineUpdater

FORMS = ("error", "loss")


class StreamXUpdater(OnlineUpdater):
    r"""One overshooting-bounded step on the latest transition, per mission and member.

    The stream-x recipe (Elsayed et al. 2024, arXiv 2410.14606) for one-step supervised
    learning: :class:`~afm_rl.learning.ObGD` without traces, :math:`z = g`, on

    * ``form="error"``: the members' error :math:`\delta = \|y - \mu\|_2` in standardised
      units, :math:`z = \nabla_w \delta`. The head of the log-variance :math:`\ell`, which
      this does not reach, takes a step on the likelihood: :math:`\delta = 1`,
      :math:`z = \nabla \sum_d [(y_d - \mu_d)^2 e^{-\ell_d} + \ell_d] / D`.
    * ``form="loss"``: the likelihood for everything, the literal reading: steps of one size
      however small the error.

    Then the model's running statistics, if it has any, see the transition. Missions,
    ``mask_key`` and faulty transitions are as in :class:`~afm_rl.learning.OnlineUpdater`.

    Args:
        loss: a loss over an :class:`~afm_rl.dynamics.Ensemble`.
        form: ``"error"`` or ``"loss"``.
        lr: step size, > 0; 1 leaves it to the bound.
        kappa: strictness of the bound, > 0.
        mask_key: boolean entry ``(*B)`` or ``(*B, 1)``: learn here?
        wrap: see :class:`~afm_rl.learning.GaussianNLLLoss`.

    Raises:
        ConfigurationError: for settings out of range, or a model that is no ensemble.

    >>> from tensordict import TensorDict
    >>> from afm_rl.spaces.manifold import Manifold
    >>> model = Ensemble(Manifold(3, angles=[2]), 2, features=[2], layer_norm=True)
    >>> updater = StreamXUpdater(GaussianNLLLoss(model.expand_(4)))
    >>> td = TensorDict({"observation": torch.zeros(4, 3), "action": torch.ones(4, 2)}, [4])
    >>> td = td.set(("next", "observation"), torch.ones(4, 3))
    >>> bool((updater(td)["loss"] > updater(td)["loss"]).all())
    True
    """

    optimizer: ObGD

    def __init__(
        self,
        loss: GaussianNLLLoss,
        form: str = "error",
        lr: float = 1.0,
        kappa: float = 2.0,
        mask_key: NestedKey | None = None,
        wrap: bool = True,
    ) -> None:
        if not isinstance(loss.model, Ensemble):
            raise ConfigurationError(
                f"updater: {type(self).__name__} teaches an Ensemble, got "
                f"{type(loss.model).__name__}; choose an ensemble, such as dynamics=pe_stream_x"
            )
        super().__init__(loss, partial(ObGD, lr=lr, kappa=kappa, lead_dims=1), mask_key, wrap)
        self.form = check_choice("updater.form", form, FORMS)

    def _measure(self, transitions: TensorDictBase) -> dict[str, Tensor]:
        """Return the loss ``(*B)`` and what it is made of, ``(*B, E, D)`` each."""
        model = cast(Ensemble, self.loss.model)
        state, action, next_state = (transitions.get(key) for key in self.loss.in_keys)
        target = self.loss.target(state, next_state).unsqueeze(-2)
        mean, log_variance = model.moments(state, action)
        loss = gaussian_nll(mean, log_variance, target).mean((-2, -1))
        found = {"loss": loss, "error": target - mean, "log_variance": log_variance}
        return {**found, "state": state, "action": action}

    def _learn(self, found: dict[str, Tensor], transitions: TensorDictBase, learn: Tensor) -> None:
        """Take one step, or one for the mean and one for the log-variance."""
        model, optimizer = cast(Ensemble, self.loss.model), self.optimizer
        optimizer.param_groups[0]["lead_dims"] = len(model.lead) + 1
        error = found["error"]
        residual = error.detach() if self.form == "error" else error
        likelihood = gaussian_nll(residual, found["log_variance"], torch.zeros_like(residual))
        spread = self._per_learner(likelihood.mean(-1), learn).sum()
        optimizer.zero_grad(set_to_none=True)
        if self.form == "error":
            head = [model.weights[-1], model.biases[-1]]
            gradients = torch.autograd.grad(spread, head, retain_graph=True)
            delta = self._per_learner(torch.linalg.vector_norm(error, dim=-1), learn)
            delta.sum().backward()
            optimizer.step(delta.detach())
            optimizer.zero_grad(set_to_none=True)
            for parameter, gradient in zip(head, gradients, strict=True):
                parameter.grad = gradient
        else:
            spread.backward()
        optimizer.step()
        model.observe_(found["state"], found["action"], learn)

    def _per_learner(self, values: Tensor, learn: Tensor) -> Tensor:
        """Average ``(*L, *N, E)`` over the transitions to learn from: ``(*L, E)``."""
        lead = self.loss.model.lead
        chosen = torch.where(learn.unsqueeze(-1), values, 0.0)
        count = learn.reshape(*lead, -1, 1).sum(-2).clamp_min(1)
        return chosen.reshape(*lead, -1, values.shape[-1]).sum(-2) / count
