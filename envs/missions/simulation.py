"""One step of missions under regimes: what all simulations share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from afm_rl.regimes import Regime, Schedule, blend_phases, shifted


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
            after["past"] = shifted(before["past"], action)
        return after

    def effect(
        self, data: TensorDictBase, action: Tensor, parameters: Tensor, noise: Tensor | None
    ) -> Tensor:
        """Return the effective action ``(*B, A)`` under the regime with these ``parameters``."""
        past = data["past"] if self.regime.history else None
        return self.regime.apply(action, parameters, data["pose"], past, noise)

    def ended(self, out: TensorDict, terminated: Tensor) -> TensorDict:
        """Add to what a step leads to whether the episode ends, ``(*B)``."""
        out["terminated"] = terminated.unsqueeze(-1).clone()
        out["truncated"] = (out["step"] >= self.steps).unsqueeze(-1)
        out["done"] = out["terminated"] | out["truncated"]
        return out

    def described(
        self, mission: TensorDictBase, state: dict[str, Tensor], **seen: Tensor
    ) -> TensorDict:
        """Return the state, the mission, the regime (hidden truth) and what is ``seen``."""
        parameters = self.regime_now(mission, state)
        entries = {**state, "mission": mission.clone(recurse=False), **seen, "regime": parameters}
        entries["regime_active"] = ~self.regime.is_identity(parameters)
        return TensorDict(entries, mission.batch_size, device=mission.device)


class BoundedSimulation(nn.Module, PhasedSimulation):
    """A simulation whose actions are clamped, before the regime acts on them.

    Args:
        regime: regime family.
        schedule: when regimes change.
        bounds: lowest and highest action, ``(A,)`` each.
        steps: most steps of an episode.
    """

    low: Tensor
    high: Tensor

    def __init__(
        self, regime: Regime, schedule: Schedule, bounds: tuple[Tensor, Tensor], steps: int
    ) -> None:
        super().__init__()
        self.regime, self.schedule, self.steps = regime, schedule, steps
        for name, bound in zip(("low", "high"), bounds, strict=True):
            self.register_buffer(name, bound, persistent=False)

    def clamped(self, data: TensorDictBase) -> Tensor:
        """Return the action within its bounds, in the precision of the pose."""
        return data["action"].to(data["pose"].dtype).clamp(self.low, self.high)
