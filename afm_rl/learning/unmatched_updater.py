"""A learner beside an action flow: it learns only what no action can undo."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from afm_rl.errors import ConfigurationError, check_instance, check_number
from afm_rl.learning.error_decomposition import check_half_range, decompose_error
from afm_rl.learning.nll import GaussianNLLLoss
from afm_rl.learning.online_updater import OnlineUpdater
from afm_rl.learning.updater import Updater

MASK = "unmatched"


class UnmatchedUpdater(Updater):
    r"""Another updater, which learns from effective actions, not from executed ones.

    The transform undoes what actions can undo. A model that learns the same from the executed
    actions works against it: both correct one error, and the transform reads its window through
    a model that keeps changing. Here each transition is taken apart first
    (:func:`~afm_rl.learning.error_decomposition.decompose_error`) into the action v that explains
    it best and a rest, in standard deviations of the model,

    .. math:: r = N^{-1}\,(s_{t+1} \ominus f(s_t, v)).

    Where :math:`\max_d |r_d|` exceeds the gate the updater learns from :math:`(s_t, v, s_{t+1})`;
    elsewhere actions explain everything, and the model stays as it is. The loss is that of the
    executed action, as with any updater.

    Args:
        loss: the loss to descend.
        updater: makes the updater that learns, ``updater(loss)``.
        scale: half range of each action, ``(A,)``.
        gate: standard deviations of the model that the rest must exceed, >= 0.

    Raises:
        ConfigurationError: for a scale that does not fit the model, or an updater with a
            mask of its own.

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

    def __init__(
        self,
        loss: GaussianNLLLoss,
        updater: Callable[[GaussianNLLLoss], OnlineUpdater],
        scale: Sequence[float] | Tensor,
        gate: float = 5.0,
    ) -> None:
        super().__init__(loss)
        self.updater = check_instance("updater.updater", updater(loss), OnlineUpdater)
        if self.updater.mask_key is not None:
            raise ConfigurationError(
                f"updater.updater.mask_key={self.updater.mask_key!r}: expected none; where to "
                "learn is decided here, by updater.gate"
            )
        self.updater.mask_key = MASK
        self.register_buffer(
            "scale", check_half_range(scale, loss.model.action_size), persistent=False
        )
        self.gate = check_number("updater.gate", gate, low=0.0)

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
        learnt = self.updater(shown.set(MASK, (parts.unmatched.abs() > self.gate).any(-1)))
        self.refused = self.updater.refused
        return learnt.set("loss", torch.where(learnt["loss"].isnan(), torch.nan, loss))
