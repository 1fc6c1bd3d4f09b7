"""What happens to a model after each step, without learning from it."""

from __future__ import annotations

import os
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import nn

from afm_rl.dynamics import Oracle
from afm_rl.errors import check_instance
from afm_rl.learning.nll import GaussianNLLLoss
from afm_rl.mission_state import MissionState
from afm_rl.spaces.keys import as_key


class Updater(nn.Module):
    """What happens to the dynamics model after each step: here, nothing (frozen).

    Called with one transition per mission, ``(*B)``; returns a tensordict with ``loss``
    ``(*B)``, measured before any update. Updaters know nothing of the transform and work in
    any loop; :attr:`loss` says which keys are read.

    Those that learn from transitions are a :class:`~afm_rl.learning.Learner`. What a subclass
    remembers of single missions belongs into a :class:`~afm_rl.mission_state.MissionState`: it
    follows when missions finish.

    Args:
        loss: how well the model explains a transition.

    >>> from afm_rl.dynamics import Dubins
    >>> updater = Updater(GaussianNLLLoss(Dubins(), reduction="none"))
    >>> td = TensorDict({"observation": torch.zeros(4, 3), "action": torch.ones(4, 2)}, [4])
    >>> updater(td.set(("next", "observation"), torch.zeros(4, 3)))["loss"].shape
    torch.Size([4])
    """

    learns = False
    """Whether missions need parameters of their own."""

    sets: str | None = None
    """What it sets in models that are conditioned on it: ``regime``, ``calibration``, or None."""

    def __init__(self, loss: GaussianNLLLoss) -> None:
        super().__init__()
        check_instance("updater.loss", loss, GaussianNLLLoss).reduction = "none"
        self.loss = loss

    def claim(self) -> None:
        """Note on the model that it changes in this process: copies in others stay behind."""
        self.loss.model.taught_in = os.getpid()

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        if self.loss.model.taught_in is not None:
            self.claim()

    def start(self, tensordict: TensorDictBase | None = None) -> None:
        """Look at the tensordict of a reset, before the first plan; forget other missions."""

    def follow(self) -> None:
        """Forget the missions that have left the model; start anew if it holds others."""
        missions = getattr(self.loss.model, "missions", None)
        if missions is None:  # the model has no parameters per mission
            return
        states = [part for part in self.modules() if isinstance(part, MissionState)]
        if not all([state.follow(missions) for state in states]):
            self.start()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Measure the loss."""
        with torch.no_grad():
            loss = self.loss(tensordict)["loss_nll"]
        return TensorDict({"loss": loss}, loss.shape)


class OracleUpdater(Updater):
    """Tell the oracle the regime that holds for the next action.

    Args:
        loss: a loss over an :class:`~afm_rl.dynamics.Oracle`.
        regime_key: where the environment publishes the regime's parameters.
    """

    sets = "regime"

    def __init__(self, loss: GaussianNLLLoss, regime_key: NestedKey = "regime") -> None:
        super().__init__(loss)
        self.regime_key = as_key(regime_key)
        self.claim()

    @property
    def oracle(self) -> Oracle:
        """The model whose regime is set."""
        return cast(Oracle, self.loss.model)

    def start(self, tensordict: TensorDictBase | None = None) -> None:
        """Tell the first regime."""
        if tensordict is not None:
            self.oracle.set_regime(tensordict.get(self.regime_key))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        result = super().forward(tensordict)
        self.start(tensordict.get("next"))
        return result
