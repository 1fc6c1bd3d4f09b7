"""What happens to a model after each step: nothing, it gets the regime, or it learns."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn

from afm_rl.compiling.devices import device_of
from afm_rl.dynamics import Oracle
from afm_rl.errors import check_instance
from afm_rl.faults import count_repeats, trusted, whole
from afm_rl.learning.loss import GaussianNLLLoss
from afm_rl.spaces.keys import as_key


class Updater(nn.Module):
    """Update a dynamics model after each step; this base class does not (frozen).

    Called with one transition per mission, ``(*B)``; returns a tensordict with ``loss``
    ``(*B)``, measured before any update. Updaters do not depend on the transform and work in
    any loop; :attr:`loss` defines the keys that are read.

    Updaters that learn from transitions derive from :class:`~afm_rl.learning.Learner`. A subclass
    stores data of single missions in :attr:`memory`, whose rows leave with their missions, and
    other changing data in :attr:`changing`. Both are part of the state dict.

    Args:
        loss: loss of the model on a transition.

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

    changing: Sequence[str] = ()
    """Attributes that change beside the memory: numbers, and what has a state of its own."""

    memory: TensorDictBase
    """What is remembered of missions, a row for each that is left, ``(l)``; () if all share one."""

    def __init__(self, loss: GaussianNLLLoss) -> None:
        super().__init__()
        check_instance("updater.loss", loss, GaussianNLLLoss).reduction = "none"
        self.loss, self.memory = loss, TensorDict()
        self._asked: tuple[Any, int] = None, 0

    def claim(self) -> None:
        """Mark the model as changing in this process; copies in other processes do not change."""
        self.loss.model.taught_in = os.getpid()

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        if self.loss.model.taught_in is not None:
            self.claim()

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Updater:
        """Move the memory too; its precision is its own, whatever that of the module."""
        self.memory = self.memory.to(fn(torch.empty(0, device=self.memory.device)).device)
        return super()._apply(fn, recurse)

    def start(self, tensordict: TensorDictBase | None = None) -> None:
        """Read the tensordict of a reset, before the first plan; forget other missions."""
        missions = getattr(self.loss.model, "missions", torch.zeros(()))
        # The numbers are not the model's own tensor: that may change in place.
        self.memory = TensorDict({"mission": missions.clone()}, missions.shape)

    def follow(self) -> None:
        """Forget the missions that have left the model; start again if it holds others."""
        missions = getattr(self.loss.model, "missions", None)
        if missions is None:  # the model has no parameters per mission
            return
        (before, version), self._asked = self._asked, (missions, missions._version)
        if before is missions and version == missions._version:
            return  # the numbers are not read, which would wait for the device
        known = self.memory.get("mission", missions.new_tensor(-1))
        if missions.shape == known.shape and torch.equal(missions, known):
            return
        if missions.dim() and known.dim() and bool(torch.isin(missions, known).all()):
            self.select_((missions.unsqueeze(-1) == known).int().argmax(-1))
        else:
            self.start()

    def select_(self, index: Tensor) -> None:
        """Keep the missions in ``index`` of those that are remembered."""
        self.memory = self.memory[index]

    def get_extra_state(self) -> dict[str, Any]:
        """Return memory and what else changes, for the state dict."""
        parts = {name: getattr(self, name) for name in self.changing}
        state = {k: p.state_dict() if hasattr(p, "state_dict") else p for k, p in parts.items()}
        return {"memory": self.memory.to_dict(), **state}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        memory, device = state["memory"], device_of(self.loss.model)
        self.memory = TensorDict(memory, memory["mission"].shape if memory else (), device=device)
        for name in self.changing:
            if hasattr(part := getattr(self, name), "load_state_dict"):
                part.load_state_dict(state[name])
            else:
                setattr(self, name, state[name])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Measure the loss."""
        with torch.no_grad():
            loss = self.loss(tensordict)["loss_nll"]
        return TensorDict({"loss": loss}, loss.shape)


class OracleUpdater(Updater):
    """Set the oracle's regime for the next action.

    Args:
        loss: a loss over an :class:`~afm_rl.dynamics.Oracle`.
        regime_key: key of the regime's parameters.
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
        """Set the first regime."""
        if tensordict is not None:
            self.oracle.set_regime(tensordict.get(self.regime_key))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        result = super().forward(tensordict)
        self.start(tensordict.get("next"))
        return result


class Learner(Updater, ABC):
    """An updater that learns from each transition; subclasses implement :meth:`_learn`.

    Transitions with an entry or loss that is not finite or absurdly large, or with a stale reading
    at either end (:mod:`afm_rl.faults`), are refused: they have no influence, their loss is
    reported as NaN, and :attr:`refused` counts them. A :class:`~afm_rl.transforms.Guard`
    reports stale readings at :attr:`sound_key`; without a guard repetitions are counted here.
    Transitions that :attr:`mask_key` excludes are only measured.

    Args:
        loss: loss of the model on a transition.
    """

    learns = True

    changing: Sequence[str] = ("refused",)

    sound_key: NestedKey = ("next", "guard", "sound")
    """Where a guard says whether the readings of a transition are sound ``(*B)``."""

    by_gradient = False
    """Whether learning needs the gradients of what is measured."""

    mask_key: NestedKey | None = None
    """Where a transition says whether to learn from it, ``(*B)`` or ``(*B, 1)``; None: from all."""

    def __init__(self, loss: GaussianNLLLoss) -> None:
        super().__init__(loss)
        self.refused = 0
        self.claim()

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
        count = self.memory.get("repeats", None)
        if count is None or count.shape != tensordict.batch_size:
            count = torch.zeros(tensordict.batch_size, device=state.device)
        repeats = count_repeats(after, state, count)
        self.memory.set("repeats", repeats)
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
