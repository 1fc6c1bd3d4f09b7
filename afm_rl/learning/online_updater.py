"""Learning by gradients, from each transition, or from what no action can undo."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Literal, cast

import torch
from annotated_types import Le
from tensordict import TensorDictBase
from torch import Tensor
from torch.optim import Optimizer

from afm_rl.dynamics import Ensemble
from afm_rl.errors import ConfigurationError, check_instance
from afm_rl.learning.error_decomposition import check_half_range, decompose_error
from afm_rl.learning.loss import GaussianNLLLoss, Wrap, gaussian_nll
from afm_rl.learning.optimisers import ObGD
from afm_rl.learning.updater import Learner, Updater
from afm_rl.options import NonNegative, Positive, options


class OnlineUpdater(Learner):
    """One gradient step on the latest transition, per mission.

    Losses are summed, so with parameters per mission (see ``DynamicsModel.expand_``) every
    mission learns from its own transition only. The optimiser's state per parameter is cut
    when missions finish, if it has the parameter's shape, as Adam's moments have.

    Args:
        loss: the loss to descend.
        optimizer: makes the optimiser of the model's parameters.

    Raises:
        ConfigurationError: if the model has no parameters, or ``optimizer`` is no function.
    """

    by_gradient = True
    changing = (*Learner.changing, "optimizer")

    @options("updater")
    def __init__(
        self,
        loss: GaussianNLLLoss,
        optimizer: Callable[..., Optimizer],
        wrap: Wrap = True,
    ) -> None:
        super().__init__(loss)
        loss.wrap = wrap
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

    def select_(self, index: Tensor) -> None:
        """Keep the missions in ``index`` of those that are remembered, in the optimiser too."""
        count = len(self.memory)
        super().select_(index)
        for parameter, state in self.optimizer.state.items():
            for name, value in state.items():
                if isinstance(value, Tensor) and value.shape == (count, *parameter.shape[1:]):
                    state[name] = value[index]

    def _learn(self, terms: dict[str, Tensor], transitions: TensorDictBase, learn: Tensor) -> None:
        """Take one step."""
        self.optimizer.zero_grad(set_to_none=True)
        torch.where(learn, terms["loss"], 0.0).sum().backward()
        self.optimizer.step()


class StreamXUpdater(OnlineUpdater):
    r"""One overshooting-bounded step on the latest transition, per mission and member.

    The stream-x recipe (Elsayed et al. 2024, arXiv 2410.14606) for one-step supervised
    learning: :class:`~afm_rl.learning.ObGD` on

    * ``form="error"``: the members' error :math:`\delta = \|y - \mu\|_2` in standardised
      units, :math:`g = \nabla_w \delta`. The head of the log-variance :math:`\ell`, which
      this does not reach, takes a step on the likelihood: :math:`\delta = 1`,
      :math:`g = \nabla \sum_d [(y_d - \mu_d)^2 e^{-\ell_d} + \ell_d] / D`.
    * ``form="loss"``: the likelihood for everything, the literal reading: steps of one size
      however small the error.

    Then the model's running statistics, if it has any, see the transition. Missions
    and faulty transitions are as in :class:`~afm_rl.learning.OnlineUpdater`.

    Args:
        loss: a loss over an :class:`~afm_rl.dynamics.Ensemble`.

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

    @options("updater")
    def __init__(
        self,
        loss: GaussianNLLLoss,
        form: Annotated[
            Literal["error", "loss"], "error: descend the prediction error; loss: the likelihood"
        ] = "error",
        lr: Annotated[Positive, "step size before the bound"] = 1.0,
        kappa: Annotated[Positive, "strength of the bound"] = 2.0,
        trace: Annotated[
            NonNegative, Le(1), "decay of eligibility traces, for form=loss; 0: none"
        ] = 0.0,
        wrap: bool = True,
    ) -> None:
        if not isinstance(loss.model, Ensemble):
            raise ConfigurationError(
                f"updater: {type(self).__name__} trains an Ensemble, got "
                f"{type(loss.model).__name__}; choose an ensemble, such as dynamics=pe_stream_x"
            )
        if trace and form == "error":
            raise ConfigurationError(
                f"updater.trace={trace}: expected 0 with updater.form=error, whose two steps would "
                "share the traces; choose updater.form=loss"
            )
        optimizer = partial(ObGD, lr=lr, kappa=kappa, lead_dims=1, trace=trace)
        super().__init__(loss, optimizer, wrap)
        self.form = form

    def _measure(self, transitions: TensorDictBase) -> dict[str, Tensor]:
        """Return the loss ``(*B)`` and what it is made of, ``(*B, E, D)`` each."""
        model = cast(Ensemble, self.loss.model)
        state, action, next_state = (transitions.get(key) for key in self.loss.in_keys)
        target = self.loss.target(state, next_state).unsqueeze(-2)
        mean, log_variance = model.moments(state, action)
        loss = gaussian_nll(mean, log_variance, target).mean((-2, -1))
        terms = {"loss": loss, "error": target - mean, "log_variance": log_variance}
        return {**terms, "state": state, "action": action}

    def _learn(self, terms: dict[str, Tensor], transitions: TensorDictBase, learn: Tensor) -> None:
        """Take one step, or one for the mean and one for the log-variance."""
        model, optimizer = cast(Ensemble, self.loss.model), self.optimizer
        optimizer.param_groups[0]["lead_dims"] = len(model.lead) + 1
        error = terms["error"]
        residual = error.detach() if self.form == "error" else error
        likelihood = gaussian_nll(residual, terms["log_variance"], torch.zeros_like(residual))
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
        learns = self._per_learner(torch.ones_like(error[..., 0]), learn)
        optimizer.step(learns)  # traces must not move those that do not learn
        model.observe_(terms["state"], terms["action"], learn)

    def _per_learner(self, values: Tensor, learn: Tensor) -> Tensor:
        """Average ``(*L, *N, E)`` over the transitions to learn from: ``(*L, E)``."""
        lead = self.loss.model.lead
        chosen = torch.where(learn.unsqueeze(-1), values, 0.0)
        count = learn.reshape(*lead, -1, 1).sum(-2).clamp_min(1)
        return chosen.reshape(*lead, -1, values.shape[-1]).sum(-2) / count


class UnmatchedUpdater(Updater):
    r"""Another updater, which learns from effective actions, not from executed ones.

    The transform undoes what actions can undo. A model that learns the same from the executed
    actions works against it: both correct one error, and the transform reads its window through
    a model that keeps changing. Here each transition is taken apart first
    (:func:`~afm_rl.learning.error_decomposition.decompose_error`) into the action v that explains
    it best and a rest, in standard deviations of the model, with J the Jacobian by the action,

    .. math:: r = (I - J J^+)\,N^{-1}\,(s_{t+1} \ominus f(s_t, v)).

    Where :math:`\max_d |r_d|` exceeds the gate the updater learns from :math:`(s_t, v, s_{t+1})`;
    elsewhere actions explain everything, and the model stays as it is. The loss is that of the
    executed action, as with any updater.

    Args:
        loss: the loss to descend.
        updater: makes the updater that learns, ``updater(loss)``.
        scale: half range of each action, ``(A,)``.

    Raises:
        ConfigurationError: for a scale that does not fit the model.

    >>> from functools import partial
    >>> from tensordict import TensorDict
    >>> from afm_rl.dynamics import Ensemble
    >>> from afm_rl.spaces.manifold import Manifold
    >>> model = Ensemble(Manifold(3, angles=[2]), 2, features=[2])
    >>> sgd = partial(OnlineUpdater, optimizer=partial(torch.optim.SGD, lr=1e-4))
    >>> updater = UnmatchedUpdater(GaussianNLLLoss(model), sgd, [1.0, 1.5])
    >>> td = TensorDict({"observation": torch.zeros(4, 3), "action": torch.ones(4, 2)}, [4])
    >>> updater(td.set(("next", "observation"), torch.ones(4, 3)))["loss"].shape
    torch.Size([4])
    """

    learns = True
    scale: Tensor

    @options("updater")
    def __init__(
        self,
        loss: GaussianNLLLoss,
        updater: Callable[[GaussianNLLLoss], OnlineUpdater],
        scale: Sequence[float] | Tensor,
        gate: Annotated[
            NonNegative, "unmatched error above which the model learns, standard deviations"
        ] = 5.0,
    ) -> None:
        super().__init__(loss)
        self.updater = check_instance("updater.updater", updater(loss), OnlineUpdater)
        self.updater.mask_key = "unmatched"
        self.register_buffer(
            "scale", check_half_range(scale, loss.model.action_size), persistent=False
        )
        self.gate = gate

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        with torch.no_grad():
            loss = self.loss(tensordict)["loss_nll"]
        shown = tensordict.select(*self.loss.in_keys, self.updater.sound_key, strict=False).copy()
        state, action, after = (shown.get(key) for key in self.loss.in_keys)
        scale = self.scale.to(action)
        with torch.no_grad():
            parts = decompose_error(self.loss.model, state, action, after, scale)
        action = torch.where(action.isfinite(), (parts.effective * scale).to(action), action)
        shown.set(self.loss.in_keys[1], action)  # a faulty action stays one
        learnt = self.updater(shown.set("unmatched", (parts.unmatched.abs() > self.gate).any(-1)))
        self.refused = self.updater.refused
        return learnt.set("loss", torch.where(learnt["loss"].isnan(), torch.nan, loss))
