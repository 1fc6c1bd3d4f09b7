"""Learning from the latest transition, or not."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.optim import Optimizer

from afm_rl.dynamics import Oracle
from afm_rl.errors import ConfigurationError, check_flag, check_instance
from afm_rl.faults import count_repeats, trusted, whole
from afm_rl.keys import as_key
from afm_rl.learning.nll import GaussianNLLLoss
from afm_rl.mission_state import MissionState


class Readings(NamedTuple):
    """What is remembered of the sensors of missions."""

    repeats: Tensor
    """How often in a row the present reading has been repeated, ``(*B)``."""


class Updater(nn.Module):
    """What happens to the dynamics model after each step: here, nothing (frozen).

    Called with one transition per mission, ``(*B)``; returns a tensordict with ``loss``
    ``(*B)``, measured before any update. Updaters know nothing of the transform and work in
    any loop; :attr:`loss` says which keys are read.

    Those that learn override :meth:`_learn`. Transitions with an entry or loss that is not finite
    or absurdly large, or with a stale reading at either end (:mod:`afm_rl.faults`), are refused:
    they have no influence, their loss is reported as NaN, and :attr:`refused` counts them.
    Those that ``mask_key`` excludes are only measured.

    What a subclass remembers of single missions belongs into a
    :class:`~afm_rl.mission_state.MissionState`: it follows when missions finish.

    Args:
        loss: how well the model explains a transition.
        mask_key: boolean entry ``(*B)`` or ``(*B, 1)``: learn here?

    >>> from afm_rl.dynamics import Dubins
    >>> updater = Updater(GaussianNLLLoss(Dubins(), reduction="none"))
    >>> td = TensorDict({"observation": torch.zeros(4, 3), "action": torch.ones(4, 2)}, [4])
    >>> updater(td.set(("next", "observation"), torch.zeros(4, 3)))["loss"].shape
    torch.Size([4])
    """

    learns = False
    """Do missions need parameters of their own?"""

    sets: str | None = None
    """What it sets in models that are conditioned on it: ``regime``, ``calibration``, or None."""

    def __init__(self, loss: GaussianNLLLoss, mask_key: NestedKey | None = None) -> None:
        super().__init__()
        check_instance("updater.loss", loss, GaussianNLLLoss).reduction = "none"
        self.loss = loss
        self.mask_key = None if mask_key is None else as_key(mask_key)
        self.refused = 0
        self.readings = MissionState(Readings(torch.zeros(())))

    def claim(self) -> None:
        """Note on the model that it changes in this process: copies in others stay behind."""
        self.loss.model.taught_in = os.getpid()

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        if self.loss.model.taught_in is not None:
            self.claim()

    def start(self, tensordict: TensorDictBase | None = None) -> None:
        """Look at the tensordict of a reset, before the first plan; forget other missions."""
        self.readings.keep(Readings(torch.zeros(())))

    def follow(self) -> None:
        """Forget the missions that have left the model; start anew if it holds others."""
        missions = getattr(self.loss.model, "missions", None)
        if missions is None:  # the model has no parameters per mission
            return
        states = [part for part in self.modules() if isinstance(part, MissionState)]
        if not all([state.follow(missions) for state in states]):
            self.start()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Measure the loss, then learn."""
        if not self.learns:
            with torch.no_grad():
                loss = self.loss(tensordict)["loss_nll"]
            return TensorDict({"loss": loss}, loss.shape)
        self.follow()
        batch = tensordict.batch_size
        kept = tensordict.select(*self.loss.in_keys).detach()
        sound = self._sound(tensordict)
        with torch.set_grad_enabled(self.by_gradient):
            found = self._measure(self._without(kept, sound))
            if not bool(found["loss"].isfinite().all()):  # sound entries may still overflow
                sound = sound & found["loss"].isfinite()
                kept = self._without(kept, sound)
                found = self._measure(kept)
            learn = sound
            if self.mask_key is not None:
                learn = sound & tensordict.get(self.mask_key).reshape(batch)
            self._learn(found, tensordict, learn)
        self.refused += int((~sound).sum())
        return TensorDict({"loss": torch.where(sound, found["loss"].detach(), torch.nan)}, batch)

    by_gradient = False
    """Does learning need the gradients of what is measured?"""

    def _sound(self, tensordict: TensorDictBase) -> Tensor:
        """Return which transitions are sound ``(*B)``; count repeated readings."""
        state, action, after = (tensordict.get(key) for key in self.loss.in_keys)
        count = self.readings.parts.repeats
        if count.shape != tensordict.batch_size:
            count = torch.zeros(tensordict.batch_size, device=state.device)
        repeats = count_repeats(after, state, count)
        self.readings.keep(Readings(repeats))
        return whole(action) & trusted(state, count) & trusted(after, repeats)

    def _measure(self, transitions: TensorDictBase) -> dict[str, Tensor]:
        """Return the ``loss`` ``(*B)``, and whatever else :meth:`_learn` wants to see."""
        return {"loss": self.loss(transitions)["loss_nll"]}

    def _learn(self, found: dict[str, Tensor], transitions: TensorDictBase, learn: Tensor) -> None:
        """Learn from transitions where ``learn`` ``(*B)`` says so; elsewhere they may be faulty."""
        raise NotImplementedError

    def _without(self, kept: TensorDictBase, sound: Tensor) -> TensorDictBase:
        """Blank what is not sound before the loss: NaN times zero is NaN."""
        blanked = kept.copy()
        for key in self.loss.in_keys:
            blanked.set(key, torch.where(sound.unsqueeze(-1), kept.get(key), 0.0))
        return blanked


class OnlineUpdater(Updater):
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

    learns = True
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
        self.claim()

    def follow(self) -> None:
        """Forget the missions that have left the model, in the optimiser too."""
        known, left = self.readings.missions, getattr(self.loss.model, "missions", None)
        super().follow()
        if left is None or not known.dim() or torch.equal(known, left):
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
        """The model to tell."""
        return cast(Oracle, self.loss.model)

    def start(self, tensordict: TensorDictBase | None = None) -> None:
        """Tell the first regime."""
        super().start()
        if tensordict is not None:
            self.oracle.tell(tensordict.get(self.regime_key))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Measure the loss, then tell the next regime."""
        result = super().forward(tensordict)
        self.start(tensordict.get("next"))
        return result
