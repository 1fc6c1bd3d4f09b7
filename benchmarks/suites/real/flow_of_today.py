"""The present correction, until it has a public ``predict``: its tick answers with the plan."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.correction import ActionFlow
from afm_rl.correction.tick import Tick
from afm_rl.dynamics import DynamicsModel


class Watching(Tick):
    """A tick that executes what was planned, and so predicts what that will do."""

    def propose(self, known, planned, box, tried):
        return planned, planned, torch.zeros_like(planned), box


class Watcher(ActionFlow):
    """An :class:`ActionFlow` that predicts."""

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        self.tick.__class__ = Watching

    def predict(
        self, memory: Tensor, action: Tensor, model: DynamicsModel
    ) -> tuple[Tensor, Tensor]:
        box = torch.stack([self.lowest, self.highest]).expand(*action.shape[:-1], 2, -1)
        memory, _ = self.correct(memory, action, model, box)
        parts = self.unpack(memory, model.state_size)
        effect = torch.where(parts["misaligned"] == 1, parts["acting"], action)
        return effect, torch.zeros_like(effect)
