"""Action flow matching as published."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Literal

import torch
from torch import Tensor, nn

from afm_rl.compiling.tracing import all_hold
from afm_rl.correction.base import Correction, Corrector, Fields
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_count
from afm_rl.options import Count, Natural, NonNegative, options
from afm_rl.spaces.manifold import draw_states, uniform


class PaperFlow(Corrector):
    r"""The published flow: one transition, from the planned action to the one that explains it.

    Trained on :math:`e = f(s, a^1) \ominus f(s, a^0)` (paper, section IV-B, eq. 19) with the
    velocity :math:`a^1 - a^0` along :math:`a^\tau = (1-\tau) a^0 + \tau a^1` (eq. 6; eq. 8 divides
    it by :math:`1 - \tau`, a slip). The gate is that of eqs. 22 and 23. It is kept for comparison:
    see the documentation for why it brings little. Its quirks have switches, set as in the
    published runs. With the rule that its authors coded, the plan is executed once a misalignment
    is noted, the transition before that describes the regime, and all other actions are
    transformed. The ``innovation`` is the norm of the error, in the mixed units of the state, not
    in standard deviations.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.

    Raises:
        ConfigurationError: for ``features`` that are no indices of state coordinates.

    >>> PaperFlow(-torch.ones(1), torch.ones(1), features=[0], state_size=2).action_size
    1
    """

    @options("corrector")
    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        features: Annotated[Sequence[Natural], "state coordinates that the network reads"],
        state_size: Annotated[Count, "state coordinates of the error, D"],
        rule: Annotated[
            Literal["text", "code"],
            "text: transform while misaligned; code: transform while aligned",
        ] = "text",
        gate: Annotated[NonNegative, "delta_M, m and rad mixed"] = 1.0,
        steps: Annotated[Count, "midpoint steps"] = 10,
        width: Annotated[Count, "units of an encoder's layers"] = 64,
        head: Annotated[Sequence[Count], "units of the hidden layers after the encoders"] = (
            128,
            64,
        ),
        error_action: Annotated[
            Literal["planned", "executed"], "reference of the errors"
        ] = "planned",
        wrap: Annotated[bool, "wrap differences of angles; the published runs did not"] = False,
        latch: Annotated[bool, "keep the transition that opened the gate; False: latest"] = True,
        seed: Annotated[Natural, "initial weights"] = 0,
    ) -> None:
        super().__init__(action_low, action_high, recent=1)
        self.state_size, self.state_features = state_size, list(features)
        if max(self.state_features, default=0) >= state_size:
            raise ConfigurationError(
                f"corrector.features={self.state_features}: expected indices of the {state_size} "
                f"state coordinates, 0 to {state_size - 1}"
            )
        self.rule, self.gate, self.steps, self.latch = rule, gate, steps, latch
        self.error_action, self.wrap, size = error_action, wrap, self.action_size
        generator = torch.Generator().manual_seed(seed)
        self.regime_encoder = mlp([self.feature_size, width, width], generator, nn.ELU)
        self.action_encoder = mlp([1 + size, width, width], generator, nn.ELU)
        self.head = mlp([2 * width, *head, size], generator, nn.ELU)

    @property
    def feature_size(self) -> int:
        """State features, action, error."""
        return len(self.state_features) + self.action_size + self.state_size

    @property
    def signature(self) -> dict[str, object]:
        """What stored weights must agree in to be loaded."""
        return {
            "kind": "PaperFlow",
            "action_size": self.action_size,
            "feature_size": self.feature_size,
        }

    def shapes(self, state_size: int) -> dict[str, tuple[int, ...]]:
        """Return names and shapes, with what describes the regime and what the coded rule notes."""
        fields = {"features": (self.feature_size,)}
        if self.rule == "code":
            fields |= {"expected": (state_size,), "known": (1,), "alarm": (1,)}
        return {**super().shapes(state_size), **fields}

    def training_loss(
        self,
        model: DynamicsModel,
        states: tuple[Tensor, Tensor] | Tensor,
        count: int,
        generator: torch.Generator,
    ) -> Tensor:
        """Return the loss of ``count`` transitions of one action registered as another's."""
        features, start, end = self._examples(model, states, count, generator)
        tau = torch.rand(count, 1, generator=generator).to(start)
        velocity = self(features, tau, torch.lerp(start, end, tau))
        return (velocity - (end - start)).square().mean()

    @torch.no_grad()
    def held_out_error(
        self,
        model: DynamicsModel,
        states: tuple[Tensor, Tensor] | Tensor,
        count: int,
        generator: torch.Generator,
    ) -> float:
        """Return the root mean square error of the action, in its own units."""
        features, start, end = self._examples(model, states, count, generator)
        return float((self._integrate(features, start) - end).square().mean().sqrt())

    def forward(self, features: Tensor, tau: Tensor, point: Tensor) -> Tensor:
        """Return the velocity ``(*B, A)`` at ``point`` and time ``tau`` ``(*B, 1)``."""
        return self._velocity(self.regime_encoder(features), tau, point)

    def _velocity(self, regime: Tensor, tau: Tensor, point: Tensor) -> Tensor:
        action = self.action_encoder(torch.cat([tau, point], -1))
        return self.head(torch.cat([regime, action], -1))

    @torch.no_grad()
    def _examples(self, model, states, count, generator) -> tuple[Tensor, Tensor, Tensor]:
        """Return features ``(N, C)``, planned and explaining actions ``(N, A)``."""
        state = model.manifold.project(draw_states(states, count, generator))
        box = self.denormalise(self.lowest), self.denormalise(self.highest)
        planned, other = (uniform(*box, count, generator) for _ in range(2))
        reached, expected = (model.forecast(state, action)[0] for action in (other, planned))
        error = self._difference(model, reached, expected)
        return self._features(state, planned, error), planned, other

    def answer(
        self, memory: Fields, planned: Tensor, model: DynamicsModel, bounds: Tensor, limits: Tensor
    ) -> tuple[Fields, Correction]:
        """Compare the last transition with the prediction; integrate from the planned action."""
        names = ("states", "planned_actions", "actions", "next_states", "valid")
        state, plan, executed, reached, valid = (memory[name].squeeze(-2) for name in names)
        coded = self.rule == "code"
        # The authors' code predicts a step before the model learns from it, the text after that.
        expected = memory["expected"] if coded else model(state, self._judged(plan, executed))
        error = self._difference(model, reached, expected)
        valid = valid == 1.0
        size = torch.where(valid, error.norm(dim=-1, keepdim=True), 0.0)
        if coded:
            error = torch.where(size < self.gate, 0.0, error)
        features = torch.where(valid, self._features(state, plan, error), 0.0)
        rule = self._as_coded if coded else self._as_written
        fields, transform = rule(memory, size, valid, features)
        correction = self.unchanged(planned, size.squeeze(-1), bounds)
        if not all_hold(~transform):
            action = self._integrate(fields["features"].to(self.scale), planned.to(self.scale))
            action = torch.where(transform, action.to(planned), planned)
            correction = correction._replace(
                executed_action=action, corrected=transform.squeeze(-1)
            )
        if coded:
            acts = self._judged(planned, correction.executed_action)
            fields["expected"] = model(memory["state"], acts)
        return fields, correction

    def _as_written(
        self, memory: Fields, size: Tensor, valid: Tensor, features: Tensor
    ) -> tuple[Fields, Tensor]:
        """Return what describes the regime, and whether the plan is transformed ``(*B, 1)``."""
        astray = size >= self.gate
        held = (memory["corrected"] == 1.0) & astray & self.latch
        return {"features": torch.where(held, memory["features"], features)}, astray

    def _as_coded(
        self, memory: Fields, size: Tensor, valid: Tensor, features: Tensor
    ) -> tuple[Fields, Tensor]:
        """Do the same as the authors coded it.

        An alarm is raised after a surprise; the next step then describes the regime, and its plan
        is executed as it is. The first step of a mission raises one, too.
        """
        alarm = (memory["alarm"] == 1.0) & valid
        known = memory["known"] == 1.0
        fields = {
            "features": torch.where(alarm, features, memory["features"]),
            "known": (known | alarm).to(size),
            "alarm": (~alarm & (~valid | (size > self.gate))).to(size),
        }
        return fields, known & ~alarm

    def _judged(self, planned: Tensor, executed: Tensor) -> Tensor:
        """Return the action whose prediction the error is taken against."""
        return planned if self.error_action == "planned" else executed

    def _difference(self, model: DynamicsModel, reached: Tensor, expected: Tensor) -> Tensor:
        """Return the error of a prediction, angles as :attr:`wrap` says."""
        if self.wrap:
            return model.manifold.difference(reached, expected)
        return reached - expected

    def _integrate(self, features: Tensor, planned: Tensor) -> Tensor:
        regime = self.regime_encoder(features)

        def velocity(tau: float, point: Tensor) -> Tensor:
            return self._velocity(regime, torch.full_like(point[..., :1], tau), point)

        return midpoint(velocity, planned, self.steps)

    def _features(self, state: Tensor, planned: Tensor, error: Tensor) -> Tensor:
        return torch.cat([state[..., self.state_features], planned, error], -1)


def midpoint(velocity: Callable[[float, Tensor], Tensor], start: Tensor, steps: int) -> Tensor:
    r"""Integrate :math:`\dot x = v(\tau, x)` from 0 to 1 with the explicit midpoint rule.

    .. math:: x_{\tau+h} = x_\tau + h\, v(\tau + h/2,\; x_\tau + \tfrac h2 v(\tau, x_\tau))

    Second order: half the step, a quarter of the error.

    Args:
        velocity: v, takes the time and the point.
        start: x_0, ``(*B, A)``.
        steps: number of equal steps.

    Raises:
        ConfigurationError: if ``steps`` is no whole number above 0.

    >>> x = midpoint(lambda tau, x: x, torch.ones(1), 100)
    >>> abs(float(x) - 2.718281828) < 1e-4
    True
    """
    check_count("corrector.steps", steps)
    step, point = 1.0 / steps, start
    for k in range(steps):
        tau = k * step
        half = point + 0.5 * step * velocity(tau, point)
        point = point + step * velocity(tau + 0.5 * step, half)
    return point


def mlp(
    sizes: Sequence[int], generator: torch.Generator, activation: type[nn.Module] = nn.ReLU
) -> nn.Sequential:
    """Return a perceptron with an activation between its layers.

    The initial weights are those of ``nn.Linear``, but drawn from ``generator``.

    >>> mlp([3, 8, 2], torch.Generator())[-1].out_features
    2
    """
    layers: list[nn.Module] = []
    for fan_in, fan_out in zip(sizes[:-1], sizes[1:], strict=True):
        linear = nn.utils.skip_init(nn.Linear, fan_in, fan_out)
        for parameter in linear.parameters():
            bound = 1 / math.sqrt(fan_in)
            nn.init.uniform_(parameter, -bound, bound, generator=generator)
        layers += [linear, activation()]
    return nn.Sequential(*layers[:-1])
