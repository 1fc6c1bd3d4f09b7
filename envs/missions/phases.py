"""What simulations of missions share: which regime acts, and since when."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from afm_rl.regimes import Regime, Schedule, blend_phases


class PhasedSimulation(ABC):
    """Base class of simulations: pure functions of missions and states.

    A state is a mapping with at least ``pose``, ``step``, ``since`` (step at which the present
    phase began) and, for a regime with a history, ``past``.

    Attributes:
        regime: regime family.
        schedule: when regimes change.
        steps: most steps of an episode.
    """

    regime: Regime
    schedule: Schedule
    steps: int

    @abstractmethod
    def begin(self, mission: TensorDictBase, dtype: torch.dtype) -> dict[str, Tensor]:
        """Return the state at the beginning of missions, without noise."""

    @abstractmethod
    def displaced(self, pose: Tensor, noise: Tensor) -> Tensor:
        """Return poses moved by start noise."""

    @abstractmethod
    def describe(self, mission: TensorDictBase, state: dict[str, Tensor]) -> TensorDict:
        """Return the state and what is seen of it."""

    @abstractmethod
    def progress(self, mission: TensorDictBase, state: Any) -> Tensor:
        """Return the share of the mission that is done, ``(*B)`` in [0, 1]."""

    def phase(self, mission: TensorDictBase, state: Any) -> Tensor:
        """Return the index of the present phase, ``(*B)``."""
        return self.schedule.phase(self.progress(mission, state), state["step"], mission["at"])

    def regime_now(self, mission: TensorDictBase, state: Any) -> Tensor:
        """Return the parameters ``(*B, F)`` that act on the next action."""
        phase, age = self.phase(mission, state), state["step"] - state["since"]
        return blend_phases(mission["parameters"], phase, age, mission["ramp"])

    def started(
        self, pose: Tensor, mission: TensorDictBase, actions: int, **more: Tensor
    ) -> dict[str, Tensor]:
        """Return a state before the first step, with ``more`` entries."""
        none = torch.zeros_like(mission["seed"])
        state = {"pose": pose, "step": none, "since": none.clone(), **more}
        if self.regime.history:
            state["past"] = pose.new_zeros(*none.shape, self.regime.history, actions)
        return state

    def followed(
        self, mission: TensorDictBase, before: Any, after: dict[str, Tensor], action: Tensor
    ) -> dict[str, Tensor]:
        """Return the state ``after`` a step with ``since``, and ``past`` with its ``action``."""
        same = self.phase(mission, before) == self.phase(mission, after)
        after["since"] = torch.where(same, before["since"], after["step"])
        if self.regime.history:
            after["past"] = torch.cat([action.unsqueeze(-2), before["past"][..., :-1, :]], -2)
        return after

    def described(
        self, mission: TensorDictBase, state: dict[str, Tensor], **seen: Tensor
    ) -> TensorDict:
        """Return the state, the mission, the regime (hidden truth) and what is ``seen``."""
        parameters = self.regime_now(mission, state)
        entries = {**state, "mission": mission.clone(recurse=False), **seen, "regime": parameters}
        entries["regime_active"] = ~self.regime.is_identity(parameters)
        return TensorDict(entries, mission.batch_size, device=mission.device)
