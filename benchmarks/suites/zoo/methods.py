"""Who acts: the policy alone, corrected, or given the truth."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from task import Task
from torch import Tensor

from afm_rl import ActionFlowVectorWrapper, FaultVectorWrapper
from afm_rl.correction import ActionFlow, L1Augmentation, LeastSquares
from afm_rl.transforms.collect_then_fit import CollectThenFit

Acting = Callable[..., np.ndarray]  # of observations, and infos if a clock counts
COLLECTING = 24  # healthy environments that a model is learned from, side by side


def alone(task: Task, envs: FaultVectorWrapper) -> tuple[Any, Acting]:
    return envs, task.act


def least_squares(task: Task, envs: FaultVectorWrapper) -> tuple[Any, Acting]:
    """Gain and offset per actuator, by least squares over effective actions."""
    corrector = LeastSquares(task.low, task.high, form="gain_offset")
    return ActionFlowVectorWrapper(envs, corrector=corrector, **task.model), task.act


def l1(task: Task, envs: FaultVectorWrapper) -> tuple[Any, Acting]:
    """L1 adaptive augmentation: filtered disturbances are taken off."""
    corrector = L1Augmentation(task.low, task.high, task.twin.unwrapped.dt)
    return ActionFlowVectorWrapper(envs, corrector=corrector, **task.model), task.act


def afm(task: Task, envs: FaultVectorWrapper) -> tuple[Any, Acting]:
    """The wrapper as it comes, over the exact model."""
    return ActionFlowVectorWrapper(envs, **task.model), task.act


def afm_longer(task: Task, envs: FaultVectorWrapper) -> tuple[Any, Acting]:
    """The same, looking for delays of up to 25 steps."""
    corrector = ActionFlow(task.low, task.high, max_delay=25)
    return ActionFlowVectorWrapper(envs, corrector=corrector, **task.model), task.act


def afm_told(task: Task, envs: FaultVectorWrapper) -> tuple[Any, Acting]:
    """The wrapper that is told the delay, for faults that are there from the first step on."""
    (delay,) = {fault.get("delay", 0) for fault in envs.faults}
    return ActionFlowVectorWrapper(envs, delay=int(delay), **task.model), task.act


@cache
def learned(task: Task) -> tuple[Any, Any]:
    """Return an ensemble that is fitted to healthy episodes of a policy, and its corrector."""
    healthy = ActionFlowVectorWrapper(task.vector(COLLECTING), CollectThenFit())
    observations, infos = healthy.reset(seed=list(range(10_000, 10_000 + COLLECTING)))
    while not infos["afm"]["learned"].all():
        for _ in range(task.steps):
            observations = healthy.step(task.act(observations))[0]
        observations, infos = healthy.reset()
    healthy.close()
    return healthy.collection.fitted, healthy._loop.corrector


def afm_learned(task: Task, envs: FaultVectorWrapper) -> tuple[Any, Acting]:
    """The same over a model that was fitted to healthy steps."""
    model, corrector = learned(task)
    return ActionFlowVectorWrapper(envs, model, corrector=corrector), task.act


class Truth:
    """The policy, given the faults as soon as they are there.

    It is asked about the state in which its command will act, and its answer is inverted. A limited
    rate is left as it is: no command makes up for it.
    """

    def __init__(self, task: Task, envs: FaultVectorWrapper) -> None:
        self.task, self.envs = task, envs

    def __call__(self, observations: np.ndarray, infos: Any = None) -> np.ndarray:
        if not self.envs.failed.any():
            return self.task.act(observations)
        actuators = self.envs.actuators
        regime, past, static = actuators.regime, actuators.past, actuators.memoryless
        lag = actuators.value("lag").unsqueeze(-1)
        keep = torch.where(lag > 0, (-1 / lag).exp(), 0.0)
        expected = observations.copy()
        delays = actuators.value("delay").int()
        for row, steps in enumerate(delays.tolist()):
            if steps:
                parameters = static[row].expand(steps, -1)
                pending = past[row, :steps].flip(0)  # oldest first
                effects = regime.apply(pending, parameters, pending[:, :1]) + actuators.home
                expected[row] = self.task.after(self.envs.unwrapped.envs[row], effects.numpy())
        arrival = {"afm": {"delay": delays.numpy()}}
        wanted = torch.as_tensor(self.task.act(expected, arrival)).double() - actuators.home
        reached = _lagged(past, keep)
        wanted = (wanted - keep * reached) / (1 - keep)
        box = self.task.low - actuators.home, self.task.high - actuators.home
        commands = regime.inverse(wanted, static, wanted[:, :1], *box)
        return (commands + actuators.home).numpy()


def _lagged(past: Tensor, keep: Tensor) -> Tensor:
    """Return where actuators with a lag are after commands ``(N, D, A)``, newest first."""
    reached = past[:, 7]  # as far back as the regime remembers
    for command in past[:, :7].flip(1).unbind(1):
        reached = command + keep * (reached - command)
    return reached


def truth(task: Task, envs: FaultVectorWrapper) -> tuple[Any, Acting]:
    return envs, Truth(task, envs)


METHODS = {
    "alone": alone,
    "least squares": least_squares,
    "L1": l1,
    "AFM": afm,
    "AFM, up to 25 steps": afm_longer,
    "AFM, told": afm_told,
    "AFM, learned": afm_learned,
    "truth": truth,
}
