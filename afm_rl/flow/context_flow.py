"""Action flow matching on a window of effective actions."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_choice, check_count, check_counts, check_number
from afm_rl.flow.base import Context, Correction, Examples, Flow, Window, rows_of
from afm_rl.flow.counterfactuals import anywhere, draw_plans, imagine_windows
from afm_rl.flow.hints import GUESSES, fit_window, shapes_of
from afm_rl.flow.network import blend, mlp
from afm_rl.flow.pairs import PairCorrector
from afm_rl.flow.proposals import nearest_of, probes_of, source_points_of
from afm_rl.flow.reading import TOLD, Reading
from afm_rl.flow.recall import Memory, recall
from afm_rl.flow.saturation import MODES, attainable, intend
from afm_rl.flow.solver import midpoint
from afm_rl.flow.views import SILENT, VIEWS, Layout, check_views, lay_out, memory_of
from afm_rl.regimes import Regime

SOON = 0.1  # of the way left: nobody need be there sooner
CHOICES = ("best", "mean")
TOLERATED = 0.25  # half ranges: a prediction that misses by so much does half as badly as can be


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
    * Which sample is best? Their mean may mean nothing where they disagree. The one is executed,
      or the mean, whose expected effect comes nearest to what can be had of the plan.
    * What can be had at all? The reach of effects, for planners that want to know.

    Least-squares fits of the window are told to both networks, which answer with a mixture of them
    and of an answer of their own (:func:`~afm_rl.flow.network.blend`): exact where a fit is.

    The model counts as misaligned while the largest surprise of the last K transitions exceeds
    ``gate`` standard deviations of the model's own noise, unless no correction at all (the view
    ``silent``) would have predicted best.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        window: pairs that a view shows, K.
        memory: transitions that are remembered, M; at least what the views read.
        views: names of :data:`~afm_rl.flow.views.VIEWS`, at least one beside ``silent``.
        place: coordinates of the state in which the ground may differ, for views by place;
            those are left out if there are none.
        place_scale: distance at which ground counts as other ground, in their unit.
        forgetting: :math:`\lambda`, of how well views did.
        gate: in standard deviations of the model.
        samples: source points; even.
        source_std: :math:`\sigma`, in half ranges.
        steps: midpoint steps.
        choose: the ``"best"`` sample by its expected effect, or always their ``"mean"``.
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
        views: Sequence[str] = tuple(VIEWS),
        place: Sequence[int] = (),
        place_scale: float = 0.5,
        forgetting: float = 0.7,
        gate: float = 5.0,
        samples: int = 16,
        source_std: float = 0.3,
        steps: int = 1,
        choose: str = "best",
        hidden: Sequence[int] = (128, 128),
        latent: int = 64,
        saturation: str = "mixed",
        seed: int = 0,
    ) -> None:
        super().__init__(action_low, action_high, check_count("corrector.memory", memory), gate)
        self.shown = check_count("corrector.window", window)
        self.place = list(place)
        self.place_scale = check_number("flow.place_scale", place_scale, low=0.0, open_low=True)
        self.views = check_views(views, by_place=bool(self.place))
        self.forgetting = check_number("corrector.forgetting", forgetting, low=0.0, high=1.0)
        self.samples = check_count("corrector.samples", samples)
        self.source_std = check_number("corrector.source_std", source_std, low=0.0)
        self.steps = check_count("corrector.steps", steps)
        self.choose = check_choice("corrector.choose", choose, CHOICES)
        self.saturation = check_choice("corrector.saturation", saturation, MODES)
        ways = [VIEWS[name] for name in self.views]
        if memory < memory_of(ways, window):
            raise ConfigurationError(
                f"corrector.memory={memory!r}: expected at least {memory_of(ways, window)} for "
                f"corrector.window={window} and the views {', '.join(self.views)}"
            )
        hidden = check_counts("corrector.hidden", hidden)
        self.latent = check_count("corrector.latent", latent)
        size = self.action_size
        generator = torch.Generator().manual_seed(check_count("flow.seed", seed, low=0))
        self.encoder = mlp([self.feature_size, *hidden, latent], generator)
        known = latent + TOLD * size
        mixed = (GUESSES + 2) * size
        self.velocity = mlp([known + size + 1, *hidden, mixed], generator)
        self.worth = mlp([known, *hidden, mixed], generator)
        fixed = {
            "source_points": source_points_of(samples, size),
            "probes": probes_of(size),
            "doubt": torch.tensor([view.doubt for view in ways]),
        }
        rows = {f"rows_{name}": part for name, part in lay_out(ways, window)._asdict().items()}
        for name, value in (fixed | rows).items():
            self.register_buffer(name, value, persistent=False)

    @property
    def feature_size(self) -> int:
        """K (executed, effective, valid)."""
        return self.shown * (2 * self.action_size + 1)

    @property
    def context_size(self) -> int:
        """What is read in each view."""
        return len(self.views) * self._reading_size

    @property
    def _reading_size(self) -> int:
        shapes = shapes_of(self.shown, self.action_size)
        return self.latent + sum(shape.numel() for shape in shapes)

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
        told = known.of_plan(planned, self.saturation)
        return self._velocity(told, known.guesses(told), tau, point)

    def _velocity(self, told: Tensor, guesses: Tensor, tau: Tensor, point: Tensor) -> Tensor:
        """Return the velocity, in shares the network's own and those that lead to the guesses."""
        ahead = (guesses - point.unsqueeze(-2)) / (1 - tau).clamp_min(SOON).unsqueeze(-1)
        return blend(self.velocity(torch.cat([told, point, tau], -1)), ahead)

    def effect(self, known: Reading, executed: Tensor) -> Tensor:
        """Return what an action ``(*B, A)`` is expected to be worth, in half ranges."""
        told = known.of_effect(executed)
        return blend(self.worth(told), known.guesses(told))

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
        size = -(-count // plans), self.shown
        window, ruling = imagine_windows(self, model, regime, states, size, generator)
        pairs = window.executed.new_zeros(*size, self.pair_size)
        pairs[window.valid] = self.judge(model, *(part[window.valid] for part in window))
        chosen = torch.arange(count) // plans
        here, ruled = window.state[chosen, -1], ruling[chosen]
        planned = draw_plans(self, regime, ruled, here, generator)
        probe = anywhere(self, count, generator)
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
        """Describe the window under the present model, and judge each view of it."""
        pairs = self.remember(window, model, last)
        surprise = self.surprise(pairs)
        surprised = surprise > self.gate
        shape = surprise.shape
        evidence = pairs.new_zeros(*shape, self.evidence_size)
        if last is not None:
            evidence = self.forgetting * last.evidence
        features = pairs.new_zeros(*shape, self.context_size)
        if not bool(surprised.any()):  # nothing to explain
            return Context(pairs, evidence, features, surprise, surprised)
        these = rows_of(surprised)
        states = window.state[these], window.next_state[these]
        memory = recall(pairs[these], *states, self.place, self.place_scale)
        if last is not None:
            ready = last.surprise[these] > self.gate  # was anything foreseen?
            counts = memory.pairs.valid[..., -1, :] * ready.unsqueeze(-1)
            evidence[these] += counts * self._misses(memory, last.features[these])
        features[these] = self._described(memory)
        misaligned = surprised.clone()
        if SILENT in self.views:
            misaligned &= self._believed(evidence) != self.views.index(SILENT)
        return Context(pairs, evidence, features, surprise, misaligned)

    def told(self, features: Tensor) -> Context:
        """Return the context in which every view shows the same."""
        described = self.read(features).pack().unsqueeze(-2)
        described = described.expand(*features.shape[:-1], len(self.views), -1)
        nothing, size = features[..., :0], features[..., 0]
        evidence = features.new_zeros(*size.shape, self.evidence_size)
        return Context(nothing, evidence, described.flatten(-2), size, size.bool())

    def _believed(self, evidence: Tensor) -> Tensor:
        """Return the index of the view that did best of late, ``(*B)``."""
        return (evidence + self.doubt).argmin(-1)

    @property
    def _layout(self) -> Layout:
        return Layout(*(getattr(self, f"rows_{name}") for name in Layout._fields))

    @torch.inference_mode()
    def _described(self, memory: Memory) -> Tensor:
        """Return what is read in each view, ``(*B, V P)``."""
        return self.read(memory.shown(self._layout)).pack().flatten(-2)

    @torch.inference_mode()
    def _misses(self, memory: Memory, features: Tensor) -> Tensor:
        """Return how badly each view foresaw the newest pair a step ago, ``(*B, V)``."""
        acted = memory.acted(self._layout)
        expected = self.effect(self._unpack(self._parts(features)), acted)
        if SILENT in self.views:
            silent = self.views.index(SILENT)
            expected[..., silent, :] = acted[..., silent, :]
        miss = (expected - memory.pairs.effective[..., -1:, :]).square()
        return (miss / (miss + TOLERATED**2)).mean(-1)

    def _parts(self, features: Tensor) -> Tensor:
        """Return what was read in each view, ``(*B, V, P)``."""
        return features.unflatten(-1, (len(self.views), -1))

    def _unpack(self, packed: Tensor) -> Reading:
        return Reading.unpack(packed, self.latent, self.shown, self.action_size)

    def correct(self, context: Context, state: Tensor, planned: Tensor) -> Correction:
        """Integrate the flow from every source point; return the best end, spread and reach."""
        with torch.inference_mode():
            found = self._correct(context, self.normalise(planned))
        return Correction(*(part.clone() for part in found))

    def _correct(self, context: Context, unit: Tensor) -> tuple[Tensor, ...]:
        believed = self._believed(context.evidence)[..., None, None]
        known = self._unpack(self._parts(context.features).take_along_dim(believed, -2))
        ends = self._ends(known, unit)
        mean, spread = ends.mean(-2, keepdim=True), ends.std(-2, correction=0)
        proposals = mean if self.choose == "mean" else torch.cat([mean, ends], -2)
        proposals = proposals.clamp(-1.0, 1.0)
        probes = self.probes.expand(*unit.shape[:-1], -1, -1)
        expected = self.effect(known, torch.cat([proposals, probes], -2))
        effects, found = expected.tensor_split([proposals.shape[-2]], -2)
        low, high = found.amin(-2), found.amax(-2)
        wanted = attainable(unit, low, high, self.saturation)
        best = nearest_of(effects, wanted, 0.5 * (high - low))
        action, effect = (
            part.take_along_dim(best, -2).squeeze(-2) for part in (proposals, effects)
        )
        reach = self.denormalise(torch.stack([low, high], -2))
        return self.denormalise(action), spread * self.half_range, reach, self.denormalise(effect)

    def _ends(self, known: Reading, unit: Tensor) -> Tensor:
        """Return where the flow leads from its source points, ``(*B, samples, A)``."""
        start = self.source(unit.unsqueeze(-2), self.source_points)
        told = known.of_plan(unit.unsqueeze(-2), self.saturation)
        told = told.expand(*start.shape[:-1], -1).flatten(end_dim=-2)
        guesses = known.guesses(told)

        def velocity(tau: float, point: Tensor) -> Tensor:
            return self._velocity(told, guesses, torch.full_like(point[..., :1], tau), point)

        return midpoint(velocity, start.flatten(end_dim=-2), self.steps).view_as(start)
