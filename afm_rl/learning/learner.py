"""Learning from the latest transition, if it can be trusted."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from afm_rl.faults import count_repeats, trusted, whole
from afm_rl.learning.nll import GaussianNLLLoss
from afm_rl.learning.updater import Updater
from afm_rl.mission_state import MissionState
from afm_rl.spaces.keys import as_key


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
    counted here. Transitions that ``mask_key`` excludes are only measured.

    Args:
        loss: how well the model explains a transition.
        mask_key: boolean entry ``(*B)`` or ``(*B, 1)``: learn here?
    """

    learns = True

    sound_key: NestedKey = ("next", "guard", "sound")
    """Where a guard says whether the readings of a transition are sound ``(*B)``."""

    by_gradient = False
    """Whether learning needs the gradients of what is measured."""

    def __init__(self, loss: GaussianNLLLoss, mask_key: NestedKey | None = None) -> None:
        super().__init__(loss)
        self.mask_key = None if mask_key is None else as_key(mask_key)
        self.refused = 0
        self.readings = MissionState(Readings(torch.zeros(())))
        self.claim()

    def start(self, tensordict: TensorDictBase | None = None) -> None:
        """Look at the tensordict of a reset, before the first plan; forget other missions."""
        self.readings.keep(Readings(torch.zeros(())))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.follow()
        batch = tensordict.batch_size
        kept = tensordict.select(*self.loss.in_keys).detach()
        sound = self._sound(tensordict)
        with torch.set_grad_enabled(self.by_gradient):
            found = self._measure(self._without(kept, sound))
            fine = sound & found["loss"].isfinite()
            if not bool(fine.all()):
                self.refused += int((~fine).sum())
                if not torch.equal(fine, sound):  # sound entries may still overflow
                    sound = fine
                    found = self._measure(self._without(kept, sound))
            learn = sound
            if self.mask_key is not None:
                learn = sound & tensordict.get(self.mask_key).reshape(batch)
            self._learn(found, tensordict, learn)
        return TensorDict({"loss": torch.where(sound, found["loss"].detach(), torch.nan)}, batch)

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
    def _learn(self, found: dict[str, Tensor], transitions: TensorDictBase, learn: Tensor) -> None:
        """Learn from transitions where ``learn`` ``(*B)`` says so; elsewhere they may be faulty."""

    def _without(self, kept: TensorDictBase, sound: Tensor) -> TensorDictBase:
        """Blank what is not sound before the loss: NaN times zero is NaN."""
        blanked = kept.copy()
        for key in self.loss.in_keys:
            blanked.set(key, torch.where(sound.unsqueeze(-1), kept.get(key), 0.0))
        return blanked
