"""Action flow matching on a window of effective actions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_choice, check_count, check_counts, check_number
from afm_rl.flow.base import Context, Correction, Examples, Flow, Window
from afm_rl.flow.counterfactuals import excite, imagine, rows_filled, rows_of_now
from afm_rl.flow.hints import ANSWERS, MISSES, Fits, fit_window
from afm_rl.flow.network import mlp
from afm_rl.flow.pairs import PairCorrector
from afm_rl.flow.saturation import MODES, attainable, intend
from afm_rl.flow.solver import midpoint
from afm_rl.flow.views import VIEWS, Memory, Pairs, memory_of
from afm_rl.regimes import Regime
from afm_rl.sampling import draw_states

SILENT = "silent"  # the hypothesis that actions are worth what they are
SILENT_DOUBT = 0.02
TOLERATED = 0.25  # half ranges: a prediction that misses by so much does half as badly as can be
PROBES = 32  # actions whose effects are asked for the reach


class Reading(NamedTuple):
    """What the networks read in a context."""

    code: Tensor
    """The encoder's, ``(*B, latent)``."""
    fits: Fits
    """Least squares of the window."""

    def wide(self) -> Reading:
        """Return the reading with one more dimension, to be asked of many actions."""
        return Reading(self.code.unsqueeze(-2), self.fits.wide())


class ContextFlow(PairCorrector, Flow):
    r"""A flow from noise around the planned action to the action that has its effect.

    The regime is described by K pairs (executed, effective action), which mean the same for
    any model and robot (:func:`~afm_rl.flow.effective.effective_action`). One network learns
    the velocity of the straight path

    .. math:: x_\tau = (1-\tau)(u_0 + \sigma\epsilon) + \tau u_1

    from the planned action :math:`u_0` to the inverse :math:`u_1 = T^{-1}(u_0)` under the
    regime T, all in half ranges. The source is noisy so that the answer does not leak and
    paths of a reflection do not cross; a fixed, antithetic set of source points makes the
    correction deterministic. A second one learns the other direction, the effect T(u) of an
    executed action. It is asked for three things:

    * Which pairs tell the present? ``views`` read the memory in several ways
      (:mod:`~afm_rl.flow.views`); the one whose predictions did best of late is believed:
      :math:`E_v \leftarrow \lambda E_v + \rho(\hat T_v(u) - u_\mathrm{eff})`,
      :math:`\rho(x) = x^2 / (x^2 + 0.25^2)`.
    * Which proposal is best? Where the flow's samples differ by more than ``unsure``, the
      context is ambiguous and their mean may mean nothing. Then that one is executed whose
      expected effect comes nearest to what can be had of the plan.
    * What can be had at all? The reach of effects, for planners that want to know.

    The model counts as misaligned while the largest surprise of the last K transitions exceeds
    ``gate`` standard deviations of the model's own noise, unless no correction at all (the view
    ``silent``) would have predicted best.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        window: pairs that a view shows, K.
        memory: transitions that are remembered, M; at least what the views read.
        views: names of :data:`~afm_rl.flow.views.VIEWS`, or ``silent``.
        place: coordinates of the state in which the ground may differ, for views by place;
            those are left out if there are none.
        place_scale: distance at which ground counts as other ground, in their unit.
        forgetting: :math:`\lambda`, of how well views did.
        gate: in standard deviations of the model.
        samples: source points; even.
        source_std: :math:`\sigma`, in half ranges.
        steps: midpoint steps.
        unsure: standard deviation of the samples above which they are judged, in half ranges.
        hidden: units of the hidden layers of all three networks.
        latent: size of the encoded context.
        saturation: what gives way when the planned action cannot be had in full, see
            :func:`~afm_rl.flow.saturation.saturate`.
        seed: seed of the initial weights.

    >>> flow = ContextFlow(torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5]))
    >>> flow.feature_size
    60
    """

    has_effect = True
    source_points: Tensor
    probes: Tensor
    doubt: Tensor

    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        window: int = 12,
        memory: int = 40,
        views: Sequence[str] = (SILENT, *VIEWS),
        place: Sequence[int] = (),
        place_scale: float = 0.5,
        forgetting: float = 0.7,
        gate: float = 5.0,
        samples: int = 8,
        source_std: float = 0.3,
        steps: int = 3,
        unsure: float = 0.1,
        hidden: Sequence[int] = (128, 128),
        latent: int = 64,
        saturation: str = "mixed",
        seed: int = 0,
    ) -> None:
        super().__init__(action_low, action_high, check_count("flow.memory", memory), gate)
        self.shown = check_count("flow.window", window)
        self.place = list(place)
        self.place_scale = check_number("flow.place_scale", place_scale, low=0.0, open_low=True)
        self.views = _check_views(views, by_place=bool(self.place))
        self._views = [VIEWS.get(name, VIEWS["recent"]) for name in self.views]
        self.forgetting = check_number("flow.forgetting", forgetting, low=0.0, high=1.0)
        self.samples = check_count("flow.samples", samples)
        self.source_std = check_number("flow.source_std", source_std, low=0.0)
        self.steps = check_count("flow.steps", steps)
        self.unsure = check_number("flow.unsure", unsure, low=0.0)
        self.saturation = check_choice("flow.saturation", saturation, MODES)
        least = memory_of([VIEWS[name] for name in self.views if name != SILENT], window)
        if memory < least:
            raise ConfigurationError(
                f"flow.memory={memory!r}: expected at least {least} for flow.window={window} and "
                f"the views {', '.join(self.views)}"
            )
        hidden = check_counts("flow.hidden", hidden)
        check_count("flow.latent", latent)
        size = self.action_size
        generator = torch.Generator().manual_seed(seed)
        self.encoder = mlp([self.feature_size, *hidden, latent], generator)
        known = latent + (ANSWERS + MISSES + 1) * size  # with what is asked about
        self.velocity = mlp([known + size + 1, *hidden, size], generator)
        self.worth = mlp([known, *hidden, size], generator)
        half = torch.randn((samples + 1) // 2, size, generator=torch.Generator().manual_seed(0))
        points = torch.cat([half, -half])[:samples]
        self.register_buffer("source_points", points, persistent=False)
        ends = torch.cat([torch.eye(size), -torch.eye(size)])
        inner = 2 * torch.quasirandom.SobolEngine(size).draw(max(1, PROBES - 2 * size)) - 1
        self.register_buffer("probes", torch.cat([ends, inner]), persistent=False)
        doubt = [VIEWS[name].doubt if name != SILENT else SILENT_DOUBT for name in self.views]
        self.register_buffer("doubt", torch.tensor(doubt), persistent=False)

    @property
    def feature_size(self) -> int:
        """K (executed, effective, valid)."""
        return self.shown * (2 * self.action_size + 1)

    @property
    def evidence_size(self) -> int:
        """One number for each view."""
        return len(self.views)

    @property
    def fresh(self) -> int:
        """A learning model is asked about the K newest transitions; older answers stand."""
        return min(self.shown, self.window)

    @property
    def signature(self) -> dict[str, object]:
        """Include what the hints depend on."""
        return {**super().signature, "saturation": self.saturation}

    def source(self, planned: Tensor, noise: Tensor) -> Tensor:
        """Return a point near the planned action."""
        return planned + self.source_std * noise

    def read(self, features: Tensor) -> Reading:
        """Return what the networks read in the context ``(*B, C)``."""
        return Reading(self.encoder(features), fit_window(*self.pairs(features)))

    def forward(self, known: Reading, planned: Tensor, tau: Tensor, point: Tensor) -> Tensor:
        """Return the velocity ``(*B, A)`` at ``point``, all actions in half ranges."""
        answers = known.fits.execute(planned, self.saturation)
        return self.velocity(torch.cat([_about(known, answers, planned), point, tau], -1))

    def effect(self, known: Reading, executed: Tensor) -> Tensor:
        """Return what an action ``(*B, A)`` is expected to be worth, in half ranges."""
        return self.worth(_about(known, known.fits.effect(executed), executed))

    def examples(
        self,
        model: DynamicsModel,
        regime: Regime,
        states: tuple[Tensor, Tensor] | Tensor,
        count: int,
        generator: torch.Generator,
        plans: int = 1,
    ) -> Examples:
        """Draw regimes from the prior and show the model's world to the flow through them.

        The newest rows of each window come from the regime to correct, the older ones from
        the regime before; some windows are not full. Half of the plans are in the action box,
        the others are effects that can be had.
        """
        contexts, rows = math.ceil(count / plans), self.shown
        size = (contexts, rows)
        now, before = regime.sample((2, contexts), generator)
        row = torch.arange(rows).expand(size)
        fresh = row >= rows - rows_of_now(contexts, rows, generator)
        parameters = torch.where(fresh.unsqueeze(-1), now.unsqueeze(1), before.unsqueeze(1))
        valid = row >= rows - rows_filled(contexts, rows, generator)
        drawn = draw_states(states, contexts * rows, generator).view(*size, -1)
        state = model.manifold.project(drawn)
        executed = self.denormalise(excite(*size, self.action_size, generator))
        low, high = self.centre - self.half_range, self.centre + self.half_range
        effect = regime.apply(executed, parameters, state)
        realised = imagine(model, state, effect, low, high, generator)
        pairs = self.judge(model, state, executed, realised, valid)
        chosen = torch.arange(count) // plans
        here, ruled = state[chosen, -1], now[chosen]

        def anywhere() -> Tensor:
            unit = 2 * torch.rand(count, self.action_size, generator=generator) - 1
            return self.denormalise(unit)

        inside = torch.rand(count, 1, generator=generator) < 0.5
        planned = torch.where(inside, anywhere(), regime.apply(anywhere(), ruled, here))
        probe = anywhere()
        return Examples(
            pairs[..., :-1].flatten(-2)[chosen],
            planned,
            self.target(regime, planned, ruled, here),
            probe,
            regime.apply(probe, ruled, here),
        )

    def target(self, regime: Regime, planned: Tensor, parameters: Tensor, state: Tensor) -> Tensor:
        """Return the action to execute under a regime: the one that has the planned effect."""
        low, high = self.centre - self.half_range, self.centre + self.half_range
        return intend(regime, planned, parameters, state, low, high, self.saturation)

    def context(self, window: Window, model: DynamicsModel, last: Context | None = None) -> Context:
        """Describe the window under the present model, through the view that did best of late."""
        pairs = self.remember(window, model, last)
        surprise = self.surprise(pairs)
        surprised = surprise > self.gate
        shape = surprise.shape
        evidence = pairs.new_zeros(*shape, self.evidence_size)
        if last is not None:
            evidence = self.forgetting * last.evidence
        features = pairs.new_zeros(*shape, self.feature_size)
        if not bool(surprised.any()):  # nothing to explain
            return Context(pairs, evidence, features, surprise, surprised)
        memory = self._recall(window, pairs, surprised)
        newest = memory.pairs.valid[:, -1]  # does it count?
        evidence[surprised] = evidence[surprised] + newest * self._misses(memory)
        best = (evidence[surprised] + self.doubt).argmin(-1)
        features[surprised] = memory.now(self._views, best, self.shown)
        misaligned = surprised.clone()
        if SILENT in self.views:
            misaligned[surprised] = best != self.views.index(SILENT)
        return Context(pairs, evidence, features, surprise, misaligned)

    def _recall(self, window: Window, pairs: Tensor, rows: Tensor) -> Memory:
        """Return what ``rows`` of the batch remember."""
        size, state = self.action_size, window.state[rows]
        seen = Pairs(*pairs[rows][..., :-1].split([size, size, 1], -1))
        here = window.next_state[rows][:, -1]
        away = [self._away(state, now) for now in (state[:, -1], here)]
        return Memory(seen, *away)

    def _away(self, there: Tensor, here: Tensor) -> Tensor:
        """Return squared distances in place ``(N, M)`` of states ``(N, M, S)`` from ``(N, S)``."""
        apart = there[..., self.place] - here[:, None, self.place]
        return (apart / self.place_scale).square().sum(-1).nan_to_num(torch.inf)

    def _misses(self, memory: Memory) -> Tensor:
        """Return how badly each view predicted the newest pair, ``(N, V)``."""
        before, acted, worth = memory.before(self._views, self.shown)
        expected = self.effect(self.read(before), acted)
        if SILENT in self.views:
            silent = self.views.index(SILENT)
            expected[:, silent] = acted[:, silent]
        miss = (expected - worth).square()
        return (miss / (miss + TOLERATED**2)).mean(-1)

    def correct(self, context: Context, state: Tensor, planned: Tensor) -> Correction:
        """Integrate the flow from every source point; return the best end, spread and reach."""
        unit = self.normalise(planned).unsqueeze(-2)
        start = self.source(unit, self.source_points)
        known = self.read(context.features)
        wanted = unit.squeeze(-2)
        fixed = _about(known, known.fits.execute(wanted, self.saturation), wanted)
        fixed = fixed.unsqueeze(-2).expand(*start.shape[:-1], -1)

        def velocity(tau: float, point: Tensor) -> Tensor:
            time = torch.full_like(point[..., :1], tau)
            return self.velocity(torch.cat([fixed, point, time], -1))

        ends = midpoint(velocity, start, self.steps)
        spread = ends.std(-2, correction=0)
        mean = ends.mean(-2, keepdim=True)
        proposals = torch.cat([mean, ends], -2).clamp(-1.0, 1.0)
        probes = self.probes.expand(*proposals.shape[:-2], *self.probes.shape)
        expected = self.effect(known.wide(), torch.cat([proposals, probes], -2))
        expected, found = expected.split([proposals.shape[-2], probes.shape[-2]], -2)
        low, high = found.amin(-2), found.amax(-2)
        wanted = attainable(unit.squeeze(-2), low, high, self.saturation)
        best = (expected - wanted.unsqueeze(-2)).square().sum(-1).argmin(-1)[..., None, None]
        chosen = proposals.gather(-2, best.expand_as(mean)).squeeze(-2)
        unsure = spread.amax(-1, keepdim=True) > self.unsure
        action = torch.where(unsure, chosen, mean.squeeze(-2))
        reach = self.denormalise(torch.stack([low, high], -2))
        return Correction(self.denormalise(action), spread * self.half_range, reach)


def _about(known: Reading, answers: Tensor, unit: Tensor) -> Tensor:
    """Return what a network is told: the code, what the fits answer, how well they fit, and u."""
    code = known.code.expand(*unit.shape[:-1], -1)
    misses = known.fits.misses.expand(*unit.shape[:-1], -1)
    return torch.cat([code, answers, misses, unit], -1)


def _check_views(views: Sequence[str], by_place: bool) -> list[str]:
    """Return the names of the views, without those by place if places are not known."""
    allowed = (SILENT, *VIEWS)
    if isinstance(views, str) or not isinstance(views, Sequence) or not views:
        raise ConfigurationError(f"flow.views={views!r}: expected a list of {', '.join(allowed)}")
    for name in views:
        check_choice("flow.views", name, allowed)
    kept = [name for name in views if by_place or not VIEWS.get(name, VIEWS["recent"]).near]
    if not set(kept) - {SILENT}:
        raise ConfigurationError(
            f"flow.views={list(views)!r}: expected one beside {SILENT}, and robot.place for views "
            "by place"
        )
    return kept
