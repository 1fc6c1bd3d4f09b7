"""What happens to a model after each step: nothing, the regime is told, or it learns."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from typing import Any, NamedTuple, cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn

from afm_rl.dynamics import Oracle
from afm_rl.errors import check_instance
from afm_rl.faults import count_repeats, trusted, whole
from afm_rl.learning.loss import GaussianNLLLoss
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
    >>> updater = Updater(GaussianNLLLoss(Dubins()))
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


class Readings(NamedTuple):
    """What is remembered of the sensors of missions."""

    repeats: Tensor
    """How often in a row the present reading has been repeated, ``(*B)``."""


class Learner(Updater, ABC):
    """An updater that learns from each transition: subclasses say how in :meth:`_learn`.

    Transitions with an entry or loss that is not finite or absurdly large, or with a stale reading
    at either end (:mod:`afm_rl.faults`), are refused: they have no influence, their loss is
    reported as NaN, and :attr:`refused` counts them. Whether a reading is stale is what a
    :class:`~afm_rl.transforms.Guard` says at :attr:`sound_key`; without a guard repetitions are
    counted here. Transitions that :attr:`mask_key` excludes are only measured.

    Args:
        loss: how well the model explains a transition.
    """

    learns = True

    sound_key: NestedKey = ("next", "guard", "sound")
    """Where a guard says whether the readings of a transition are sound ``(*B)``."""

    by_gradient = False
    """Whether learning needs the gradients of what is measured."""

    mask_key: NestedKey | None = None
    """Where a transition says whether to learn from it, ``(*B)`` or ``(*B, 1)``; None: from all."""

    def __init__(self, loss: GaussianNLLLoss) -> None:
        super().__init__(loss)
        self.refused = 0
        self.readings = MissionState(Readings(torch.zeros(())))
        self.claim()

    def start(self, tensordict: TensorDictBase | None = None) -> None:
        """Look at the tensordict of a reset, before the first plan; forget other missions."""
        self.readings.keep(Readings(torch.zeros(())))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.follow()
        batch = tensordict.batch_size
        transitions = tensordict.select(*self.loss.in_keys).detach()
        sound = self._sound(tensordict)
        with torch.set_grad_enabled(self.by_gradient):
            terms = self._measure(self._without(transitions, sound))
            fine = sound & terms["loss"].isfinite()
            if not bool(fine.all()):
                self.refused += int((~fine).sum())
                if not torch.equal(fine, sound):  # sound entries may still overflow
                    sound = fine
                    terms = self._measure(self._without(transitions, sound))
            learn = sound
            if self.mask_key is not None:
                learn = sound & tensordict.get(self.mask_key).reshape(batch)
            self._learn(terms, tensordict, learn)
        return TensorDict({"loss": torch.where(sound, terms["loss"].detach(), torch.nan)}, batch)

    def _sound(self, tensordict: TensorDictBase) -> Tensor:
        """Return which transitions are sound ``(*B)``; count repeats if no guard does."""
        state, action, after = (tensordict.get(key) for key in self.loss.in_keys)
        verdict = tensordict.get(self.sound_key, None)
        if verdict is not None:
            return verdict & whole(state) & whole(action) & whole(after)
        count = self.readings.parts.repeats
        if count.shape != tensordict.batch_size:
            count = torch.zeros(tensordict.batch_size, device=state.device)
        repeats = count_repeats(after, state, count)
        self.readings.keep(Readings(repeats))
        return whole(action) & trusted(state, count) & trusted(after, repeats)

    def _measure(self, transitions: TensorDictBase) -> dict[str, Tensor]:
        """Return the ``loss`` ``(*B)``, and whatever else :meth:`_learn` wants to see."""
        return {"loss": self.loss(transitions)["loss_nll"]}

    @abstractmethod
    def _learn(self, terms: dict[str, Tensor], transitions: TensorDictBase, learn: Tensor) -> None:
        """Learn from transitions where ``learn`` ``(*B)`` says so; elsewhere they may be faulty."""

    def _without(self, transitions: TensorDictBase, sound: Tensor) -> TensorDictBase:
        """Blank what is not sound before the loss: NaN times zero is NaN."""
        blanked = transitions.copy()
        for key in self.loss.in_keys:
            blanked.set(key, torch.where(sound.unsqueeze(-1), transitions.get(key), 0.0))
        return blanked
