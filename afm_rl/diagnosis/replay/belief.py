"""What action flow matching believes that each command of a log will do."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel, KnownDynamics
from afm_rl.manifold import Manifold


class Believer(Protocol):
    """What a corrector must do to be replayed; all pure functions of a memory ``(*B, P)``."""

    def begin(self, state: Tensor) -> Tensor:
        """Return the memory of missions that begin in ``state``."""

    def predict(
        self, memory: Tensor, action: Tensor, model: DynamicsModel
    ) -> tuple[Tensor, Tensor]:
        """Return the effect that ``action`` would have, and its standard deviation, ``(*B, A)``."""

    def correct(
        self, memory: Tensor, planned: Tensor, model: DynamicsModel, box: Tensor
    ) -> tuple[Tensor, object]:
        """Return the memory in which a plan is decided."""

    def executing(self, memory: Tensor, planned: Tensor, executed: Tensor) -> Tensor:
        """Return the memory in which ``executed`` was executed."""

    def observe(self, memory: Tensor, next_state: Tensor) -> Tensor:
        """Return the memory with the transition to ``next_state``."""


def identity(size: int) -> KnownDynamics:
    """Return the model of a healthy robot whose state is its response: the last command.

    >>> identity(2)(torch.zeros(2), torch.tensor([0.1, 0.2]))
    tensor([0.1000, 0.2000])
    """
    return KnownDynamics(
        lambda state, action: action + 0 * state, Manifold(size), size, affine=True
    )


@torch.no_grad()
def believe(
    corrector: Believer, command: np.ndarray, response: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return what each command was predicted to do, and the standard deviation.

    A row is predicted from its command and from earlier rows. The corrector never acts.

    Args:
        corrector: made for actions in [-1, 1].
        command: rows of logs side by side, in units of the largest command, ``(T, *B, A)``.
        response: in the same unit, ``(T, *B, A)``.
    """
    sent, seen = (torch.as_tensor(part, dtype=torch.float32) for part in (command, response))
    model = identity(sent.shape[-1])
    box = torch.stack([-torch.ones_like(sent[0]), torch.ones_like(sent[0])], -2)
    memory, found = corrector.begin(torch.zeros_like(seen[0])), []
    for action, state in zip(sent, seen, strict=True):
        found.append(torch.stack(corrector.predict(memory, action, model)))
        memory, _ = corrector.correct(memory, action, model, box)
        memory = corrector.observe(corrector.executing(memory, action, action), state)
    effect, std = torch.stack(found, 1).numpy().astype(float)
    return effect, std
