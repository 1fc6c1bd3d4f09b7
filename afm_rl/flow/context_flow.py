"""Action flow matching on a window of effective actions."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import check_choice, check_count, check_counts, check_number
from afm_rl.flow.base import Context, Examples, Flow
from afm_rl.flow.hints import FITS, least_squares_hints
from afm_rl.flow.network import mlp
from afm_rl.flow.pairs import PairCorrector
from afm_rl.flow.saturation import MODES, intend
from afm_rl.flow.solver import midpoint
from afm_rl.regimes import Regime
from afm_rl.sampling import uniform


class ContextFlow(PairCorrector, Flow):
    r"""A flow from noise around the planned action to the action that has its effect.

    The regime is described by K pairs (executed, effective action), which mean the same for
    any model and robot (:func:`~afm_rl.flow.effective.effective_action`). The network learns
    the velocity of the straight path

    .. math:: x_\tau = (1-\tau)(u_0 + \sigma\epsilon) + \tau u_1

    from the planned action :math:`u_0` to the inverse :math:`u_1 = T^{-1}(u_0)` under the
    regime T, all in half ranges. The source is noisy so that the answer does not leak and
    paths of a reflection do not cross; a fixed, antithetic set of source points makes the
    correction deterministic. The model counts as misaligned while the largest surprise in
    the window exceeds ``gate`` standard deviations of the model's own noise.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        window: transitions in the context, K.
        gate: in standard deviations of the model.
        samples: source points, averaged; even.
        source_std: :math:`\sigma`, in half ranges.
        steps: midpoint steps.
        hidden: units of the hidden layers of encoder and velocity network.
        latent: size of the encoded context.
        saturation: what gives way when the planned action cannot be had in full:
            ``"direction"`` does the same thing slower, ``"clip"`` cuts each component.
        seed: seed of the initial weights.

    >>> flow = ContextFlow(torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5]))
    >>> flow.feature_size
    30
    """

    source_points: Tensor

    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        window: int = 6,
        gate: float = 5.0,
        samples: int = 8,
        source_std: float = 0.3,
        steps: int = 3,
        hidden: Sequence[int] = (128, 128),
        latent: int = 64,
        saturation: str = "direction",
        seed: int = 0,
    ) -> None:
        super().__init__(action_low, action_high, window, gate)
        self.samples = check_count("flow.samples", samples)
        self.source_std = check_number("flow.source_std", source_std, low=0.0)
        self.steps = check_count("flow.steps", steps)
        self.saturation = check_choice("flow.saturation", saturation, MODES)
        hidden = check_counts("flow.hidden", hidden)
        check_count("flow.latent", latent)
        size = self.action_size
        generator = torch.Generator().manual_seed(seed)
        self.encoder = mlp([self.feature_size, *hidden, latent], generator)
        self.hint_size = 2 * FITS * size
        known = latent + self.hint_size + 2 * size  # with the plan and the point on the path
        self.velocity = mlp([known + 1, *hidden, size], generator)
        half = torch.randn((samples + 1) // 2, size, generator=torch.Generator().manual_seed(0))
        points = torch.cat([half, -half])[:samples]
        self.register_buffer("source_points", points, persistent=False)

    @property
    def signature(self) -> dict[str, object]:
        """Include what the hints depend on."""
        return {**super().signature, "saturation": self.saturation}

    def source(self, planned: Tensor, noise: Tensor) -> Tensor:
        """Return a point near the planned action."""
        return planned + self.source_std * noise

    def forward(self, features: Tensor, planned: Tensor, tau: Tensor, point: Tensor) -> Tensor:
        """Return the velocity ``(*B, A)`` at ``point``, all actions in half ranges."""
        known = torch.cat([self.encoder(features), self.hints(features, planned)], -1)
        return self.velocity(torch.cat([known, planned, point, tau], -1))

    def hints(self, features: Tensor, planned: Tensor) -> Tensor:
        """Return what least squares would execute, and how well it fits, ``(*B, hint_size)``."""
        return least_squares_hints(*self.pairs(features), planned, self.saturation)

    def examples(
        self,
        model: DynamicsModel,
        regime: Regime,
        state_box: tuple[Tensor, Tensor],
        count: int,
        generator: torch.Generator,
        plans: int = 1,
    ) -> Examples:
        """Draw regimes from the prior and show the model's world to the flow through them.

        The newest rows of each window come from the regime to correct, the older ones from
        the regime before; some windows are not full yet.
        """
        contexts = math.ceil(count / plans)
        size = (contexts, self.window)
        now, before = regime.sample((2, contexts), generator)
        row = torch.arange(self.window).expand(size)
        newest = _newest(contexts, self.window, generator)
        fresh = row >= self.window - newest
        parameters = torch.where(fresh.unsqueeze(-1), now.unsqueeze(1), before.unsqueeze(1))
        valid = row >= _missing(self.window, newest, generator)
        drawn = uniform(*state_box, contexts * self.window, generator).view(*size, -1)
        state = model.manifold.project(drawn)
        executed = self.denormalise(_excite(*size, self.action_size, generator))
        low, high = self.centre - self.half_range, self.centre + self.half_range
        effect = regime.apply(executed, parameters, state)
        realised = _imagine(model, state, effect, low, high, generator)
        features, _ = self.describe(model, state, executed, realised, valid)
        planned = self.denormalise(2 * torch.rand(count, self.action_size, generator=generator) - 1)
        rows = torch.arange(count) // plans
        intended = self.target(regime, planned, now[rows], state[rows, -1])
        return Examples(features[rows], planned, intended)

    def target(self, regime: Regime, planned: Tensor, parameters: Tensor, state: Tensor) -> Tensor:
        """Return the action to execute under a regime: the one that has the planned effect."""
        low, high = self.centre - self.half_range, self.centre + self.half_range
        return intend(regime, planned, parameters, state, low, high, self.saturation)

    def correct(self, context: Context, state: Tensor, planned: Tensor) -> tuple[Tensor, Tensor]:
        """Integrate the flow from every source point; return mean and spread."""
        unit = self.normalise(planned).unsqueeze(-2)
        start = self.source(unit, self.source_points)
        hints = self.hints(context.features, unit.squeeze(-2))
        known = torch.cat([self.encoder(context.features), hints], -1)
        known = torch.cat([known.unsqueeze(-2), unit], -1).expand(*start.shape[:-1], -1)

        def velocity(tau: float, point: Tensor) -> Tensor:
            time = torch.full_like(point[..., :1], tau)
            return self.velocity(torch.cat([known, point, time], -1))

        end = midpoint(velocity, start, self.steps)
        spread = end.std(-2, correction=0) * self.half_range
        return self.denormalise(end.mean(-2)), spread


def _imagine(
    model: DynamicsModel,
    state: Tensor,
    effect: Tensor,
    low: Tensor,
    high: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Return noisy next states ``(*B, S)`` under effective actions, also beyond the box.

    A learned model knows nothing outside the box, so it is continued linearly from its edge.
    """
    inside = torch.minimum(torch.maximum(effect, low), high)
    state_at_edge, noise = model.forecast(state, inside)
    slope = model.jacobian(state, inside)
    beyond = (slope @ (effect - inside).unsqueeze(-1)).squeeze(-1)
    error = noise * torch.randn(noise.shape, generator=generator)
    return model.manifold.add(state_at_edge, beyond + error)


def _newest(count: int, window: int, generator: torch.Generator) -> Tensor:
    """How many rows are from the present regime ``(N, 1)``: all in half of the windows."""
    some = torch.randint(1, window + 1, (count, 1), generator=generator)
    full = torch.rand(count, 1, generator=generator) < 0.5
    return torch.where(full, window, some)


def _missing(window: int, newest: Tensor, generator: torch.Generator) -> Tensor:
    """How many of the oldest rows are missing ``(N, 1)``: some in one window of ten."""
    drawn = torch.rand(newest.shape, generator=generator)
    most = torch.where(newest == window, window, window - newest + 1)
    few = (torch.rand(newest.shape, generator=generator) * most).long()
    return torch.where(drawn < 0.1, few, 0)


def _excite(count: int, window: int, size: int, generator: torch.Generator) -> Tensor:
    """Executed actions ``(N, K, A)`` in u: half the windows move about one action only."""
    wide = 2 * torch.rand(count, window, size, generator=generator) - 1
    around = 2 * torch.rand(count, 1, size, generator=generator) - 1
    reach = 0.4 * torch.rand(count, 1, size, generator=generator)
    narrow = (around + reach * wide).clamp(-1, 1)
    return torch.where(torch.rand(count, 1, 1, generator=generator) < 0.5, wide, narrow)
