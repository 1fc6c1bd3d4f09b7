"""Action flow matching as published."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import (
    ConfigurationError,
    check_choice,
    check_count,
    check_counts,
    check_flag,
)
from afm_rl.flow.base import Context, Correction, Examples, Flow, Window
from afm_rl.flow.network import mlp
from afm_rl.flow.solver import midpoint
from afm_rl.regimes import Regime
from afm_rl.sampling import draw_states, uniform


class PaperFlow(Flow):
    r"""The published flow: one transition, from the planned action to the one that explains it.

    Trained on :math:`e = f(s, a^1) \ominus f(s, a^0)` with the velocity
    :math:`a^1 - a^0` along :math:`a^\tau = (1-\tau) a^0 + \tau a^1` (paper, section IV-C).
    It is kept for comparison: see the documentation for why it brings little. Its quirks
    have switches, set as in the published runs.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        features: indices of the state coordinates that the network sees.
        state_size: number of state coordinates, D of the error.
        gate: the threshold delta_M on the error's norm, in mixed units (m, rad).
        steps: midpoint steps.
        width: units of every layer, 64 in the paper.
        error_action: the action whose prediction the error is taken against: ``"planned"``
            as published, or ``"executed"``.
        wrap: take differences on the manifold; the published runs subtracted angles.
        latch: keep the transition that opened the gate until it closes (as published)
            instead of using the latest.
        seed: seed of the initial weights.

    Raises:
        ConfigurationError: for a setting that cannot be used.
    """

    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        features: Sequence[int],
        state_size: int,
        gate: float = 1.0,
        steps: int = 10,
        width: int = 64,
        error_action: str = "planned",
        wrap: bool = False,
        latch: bool = True,
        seed: int = 0,
    ) -> None:
        super().__init__(action_low, action_high, gate, window=1)
        self.state_size = check_count("flow.state_size", state_size)
        self.state_features = check_counts("flow.features", features, low=0)
        if max(self.state_features, default=0) >= state_size:
            raise ConfigurationError(
                f"flow.features={self.state_features}: expected indices of the {state_size} "
                f"state coordinates, 0 to {state_size - 1}"
            )
        self.steps = check_count("corrector.steps", steps)
        self.error_action = check_choice(
            "corrector.error_action", error_action, ("planned", "executed")
        )
        self.wrap = check_flag("corrector.wrap", wrap)
        self.latch = check_flag("corrector.latch", latch)
        check_count("corrector.width", width)
        size = self.action_size
        generator = torch.Generator().manual_seed(check_count("flow.seed", seed, low=0))
        self.regime_encoder = mlp([self.feature_size, width, width], generator)
        self.action_encoder = mlp([1 + size, width, width], generator)
        self.head = mlp([2 * width, width, width, size], generator)

    @property
    def feature_size(self) -> int:
        """State features, action, error."""
        return len(self.state_features) + self.action_size + self.state_size

    def normalise(self, action: Tensor) -> Tensor:
        """Return the action: the published network works in raw units."""
        return action

    def denormalise(self, unit: Tensor) -> Tensor:
        """Return the action."""
        return unit

    def source(self, planned: Tensor, noise: Tensor) -> Tensor:
        """Return the planned action: the published path starts there."""
        return planned

    def forward(self, known: Tensor, planned: Tensor, tau: Tensor, point: Tensor) -> Tensor:
        """Return the velocity at ``point``; the planned action is among the features."""
        return self._velocity(self.regime_encoder(known), tau, point)

    def _velocity(self, regime: Tensor, tau: Tensor, point: Tensor) -> Tensor:
        action = self.action_encoder(torch.cat([tau, point], -1))
        return self.head(torch.nn.functional.elu(torch.cat([regime, action], -1)))

    def examples(
        self,
        model: DynamicsModel,
        regime: Regime,
        states: tuple[Tensor, Tensor] | Tensor,
        count: int,
        generator: torch.Generator,
        plans: int = 1,
    ) -> Examples:
        """Register transitions of one action as if they came from another.

        The plan is part of the context, so each has its own.
        """
        state = model.manifold.project(draw_states(states, count, generator))
        box = (self.centre - self.half_range, self.centre + self.half_range)
        planned, intended = (uniform(*box, count, generator) for _ in range(2))
        error = model.manifold.difference(model(state, intended), model(state, planned))
        features = self._features(state, planned, error)
        return Examples(features, planned, intended, planned, intended)

    def context(self, window: Window, model: DynamicsModel, last: Context | None = None) -> Context:
        """Compare the last transition with the model's prediction."""
        row = Window(*(part.narrow(window.valid.dim() - 1, -1, 1) for part in window))
        action = row.planned if self.error_action == "planned" else row.executed
        expected = model(row.state, action)
        raw = row.next_state - expected
        error = model.manifold.difference(row.next_state, expected) if self.wrap else raw
        size = torch.where(row.valid, error.norm(dim=-1), 0.0).squeeze(-1)
        misaligned = size >= self.gate
        features = self._features(row.state, row.planned, error).squeeze(-2)
        if self.latch and last is not None:
            held = (last.misaligned & misaligned).unsqueeze(-1)
            features = torch.where(held, last.features, features)
        nothing = features.new_zeros(*size.shape, 0)
        pairs = features.new_zeros(*window.valid.shape, 0)
        return Context(pairs, nothing, features, size, misaligned)

    def correct(self, context: Context, state: Tensor, planned: Tensor) -> Correction:
        """Integrate the flow from the planned action."""
        regime = self.regime_encoder(context.features)

        def velocity(tau: float, point: Tensor) -> Tensor:
            return self._velocity(regime, torch.full_like(point[..., :1], tau), point)

        return Correction(midpoint(velocity, planned, self.steps), torch.zeros_like(planned))

    def _features(self, state: Tensor, planned: Tensor, error: Tensor) -> Tensor:
        return torch.cat([state[..., self.state_features], planned, error], -1)
