"""A model that is fitted to healthy steps, which are collected first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from afm_rl.correction import Correction, Corrector
from afm_rl.correction.base import Fields
from afm_rl.dynamics import DynamicsModel, Ensemble
from afm_rl.learning.fitting import FitReport, fit_ensemble
from afm_rl.options import Count, Natural, NonNegative, Positive, options
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms.loop import CorrectionLoop


@options("learn")
@dataclass
class CollectThenFit:
    r"""Learns an :class:`~afm_rl.dynamics.Ensemble` from transitions of a healthy robot.

    After ``transitions`` of them it is fitted, when the next episode begins. It is good enough when
    its held-out error, root mean square in standard deviations of the data, is at most ``error``;
    if not, twice as many transitions are waited for.

    A policy's action is a function of the state, so that its own data do not show what another
    action would have done. Normal noise on the executed action does. Every robot has a standard
    deviation of its own, drawn again between 0 and ``noise`` every ``hold`` steps: so the model
    knows the policy's own motion well, and also what is around it.

    Args:
        fit: settings of :func:`~afm_rl.learning.fit_ensemble`.
        model: settings of the ensemble.
        manifold: of the states; plain numbers if None.

    >>> collection = CollectThenFit(transitions=300, model={"hidden": [16], "members": 2})
    >>> state, action = torch.randn(300, 1, 2), torch.randn(300, 1, 1)
    >>> for s, a in zip(state, action, strict=True):
    ...     collection.add(s, a, s + 0.5 * a)
    >>> collection.due
    True
    """

    transitions: Annotated[Count, "data collected before the first fit"] = 24_000
    error: Annotated[Positive, "held-out error up to which a model is used"] = 0.5
    noise: Annotated[NonNegative, "largest standard deviation, half ranges; 0: no noise"] = 0.4
    hold: Annotated[Count, "steps for which a robot keeps its own deviation"] = 20
    fit: Mapping[str, Any] = field(
        default_factory=lambda: {"epochs": 100, "batch_size": 128, "lr": 8e-3, "beta": 0.5}
    )
    model: Mapping[str, Any] = field(
        default_factory=lambda: {"hidden": [256] * 3, "members": 3, "layer_norm": True}
    )
    manifold: Manifold | None = None
    seed: Annotated[Natural, "seed of noise and fit"] = 0
    fitted: Ensemble | None = field(default=None, init=False, repr=False)
    """The model, once it is good enough."""
    report: FitReport | None = field(default=None, init=False)
    """Of the newest fit."""
    _seen: list[list[Tensor]] = field(default_factory=list, init=False, repr=False)

    def __post_init__(self) -> None:
        """Draw from the seed."""
        self.needed = self.transitions
        self.restart(self.seed)

    @property
    def count(self) -> int:
        """Number of transitions that were collected."""
        return sum(map(len, self._seen))

    @property
    def due(self) -> bool:
        """Are there enough transitions for the next fit?"""
        return self.fitted is None and self.count >= self.needed

    def add(self, state: Tensor, action: Tensor, next_state: Tensor) -> None:
        """Remember a transition of each of N robots: ``(N, S)``, ``(N, A)``; not what is NaN."""
        if not self._seen:
            self._seen = [[] for _ in range(len(state))]
            self._sizes = state.shape[-1], action.shape[-1]
        rows = torch.cat([state, action, next_state], -1)
        for transitions, row, whole in zip(self._seen, rows, rows.isfinite().all(-1), strict=True):
            if bool(whole):
                transitions.append(row)

    def restart(self, seed: int) -> None:
        """Draw the noise of actions from ``seed`` on."""
        self._random, self._steps = np.random.default_rng(seed), 0

    def excitation(self, shape: Sequence[int]) -> Tensor:
        """Return the noise ``(N, A)`` of this step, in half ranges."""
        if self._steps % self.hold == 0:
            self._level = self.noise * self._random.random((shape[0], 1))
        self._steps += 1
        return torch.from_numpy(self._level * self._random.standard_normal(shape))

    def collecting(self, loop: CorrectionLoop) -> CorrectionLoop:
        """Return the loop that collects, for the time before there is a model."""
        corrector = Excitation(loop.corrector, self)
        options = loop.options | {"delay_compensation": False}
        return CorrectionLoop(loop.owner, loop.model, corrector, **options)

    def fits(self) -> bool:
        """Fit a model if there is enough for it; is it good enough?"""
        return self.due and self.learn().error <= self.error

    def learn(self) -> FitReport:
        """Fit a model to all that was collected; :attr:`fitted` is set if it is good enough."""
        states, actions = self._sizes
        rows = torch.stack([row for own in self._seen for row in own])
        manifold = Manifold(states) if self.manifold is None else self.manifold
        features, settings = list(range(states)), {"seed": self.seed, **self.model}
        model = Ensemble(manifold, actions, features, **settings)
        names = ("observation", "action", ("next", "observation"))
        parts = rows.split([states, actions, states], -1)
        data = TensorDict({}, [len(rows)]).update(dict(zip(names, parts, strict=True)))
        settings = {"seed": self.seed, "progress": True, **self.fit}
        self.report = fit_ensemble(model, data, **settings)
        if self.report.error <= self.error:
            self.fitted = model.requires_grad_(False)
        else:
            self.needed = 2 * self.count
        return self.report


class Excitation(Corrector):
    """Adds noise to actions, and hands transitions on to a collection.

    Args:
        corrector: that comes afterwards, whose belief is that of a beginning until then.
        collection: where noise comes from and transitions go.
    """

    def __init__(self, corrector: Any, collection: CollectThenFit) -> None:
        low, high = map(corrector.denormalise, (corrector.lowest, corrector.highest))
        super().__init__(low, high, recent=1, delay=corrector.delay)
        self.corrector, self.collection = corrector, collection
        self.causes = corrector.causes

    def observe(self, memory: Fields, next_state: Tensor) -> Fields:
        """Collect the transition, too."""
        self.collection.add(memory["state"], memory["executed_action"], next_state)
        return super().observe(memory, next_state)

    def answer(
        self, memory: Fields, planned: Tensor, model: DynamicsModel, bounds: Tensor, limits: Tensor
    ) -> tuple[Fields, Correction]:
        """Return the planned action with noise, within the limits."""
        low, high = bounds.unbind(-2)
        noise = self.collection.excitation(planned.shape).to(planned)
        noisy = (planned + noise * (high - low) / 2).clamp(*limits.unbind(-2))
        correction = self.unchanged(planned, torch.zeros_like(planned[..., 0]), bounds)
        return {}, correction._replace(executed_action=noisy, predicted_effect=noisy)

    def belief_in(self, memory: Fields) -> Tensor:
        """Return the belief of a beginning."""
        return self.corrector.belief_in(self.corrector.begin(memory["state"]))
