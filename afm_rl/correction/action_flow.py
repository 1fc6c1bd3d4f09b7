"""Action flow matching: one corrector for every robot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from afm_rl.correction.base import Correction, Fields, rows_of
from afm_rl.correction.choice import nearest_of, probes_of, source_points_of
from afm_rl.correction.compiled import compile_tick
from afm_rl.correction.counterfactuals import draw_counterfactuals
from afm_rl.correction.hypotheses import (
    HYPOTHESES,
    IDENTITY,
    Layout,
    check_hypotheses,
    lay_out,
    memory_of,
    read_rows,
)
from afm_rl.correction.pairs import PairCorrector
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_choice, check_count, check_flag, check_number
from afm_rl.flow.experts import Rows, fit_experts
from afm_rl.flow.network import AxisNetwork, Encoded
from afm_rl.flow.prior import Drawn
from afm_rl.flow.saturation import MODES, attainable
from afm_rl.flow.solver import midpoint
from afm_rl.flow.training import EFFECT_WEIGHT, States, flow_losses
from afm_rl.flow.weights import load_universal
from afm_rl.regimes import Regime

TOLERANCE = 0.25  # half ranges: a prediction that misses by so much has half the largest loss
PLANS = 4  # for each window, in training
ROWS = 12  # pairs that a hypothesis reads, at least


class Answer(NamedTuple):
    """What a tick makes of plans, in half ranges."""

    losses: Tensor
    """Of the hypotheses, ``(*B, H + 1)``."""
    predicted: Tensor
    """Effects that they predict, ``(*B, H + 1, A)``."""
    aligned: Tensor
    """Is no correction believed? ``(*B, 1)``."""
    action: Tensor
    """To execute, ``(*B, A)``."""
    effect: Tensor
    """That it is predicted to have, ``(*B, A)``."""
    spread: Tensor
    """Of the samples, ``(*B, A)``."""
    bounds: Tensor
    """Lowest and highest effect, ``(*B, 2, A)``."""


class ActionFlow(PairCorrector):
    r"""The flow from noise around the planned action to the action that has its effect.

    A regime is described by pairs (executed, effective action), which mean the same for every
    model and robot (:func:`~afm_rl.dynamics.inverse.effective_action`). One network, trained once
    on regimes without any robot (:mod:`~afm_rl.flow.prior`), answers for any number of actions.
    At every tick (:meth:`correct`):

    1. *Innovation and effective action*: what did the last transition show?
    2. *Gate*: while no innovation exceeds ``gate`` standard deviations of the model's noise, the
       planned action is executed.
    3. *Hypotheses*: the memory is read in several ways (:mod:`~afm_rl.correction.hypotheses`).
       Each predicts the next effect; the one with the smallest discounted loss
       :math:`L \leftarrow \lambda L + \rho(\hat T(u) - u_\mathrm{eff})`,
       :math:`\rho(x) = x^2 / (x^2 + 0.25^2)`, is believed. No correction at all is one of them.
    4. *Experts* fit its pairs, and the network encodes both.
    5. *Flow*: straight paths :math:`x_\tau = (1-\tau)(u_0 + \sigma\epsilon) + \tau u_1` lead from
       around the plan :math:`u_0` to the inverse :math:`u_1 = T^{-1}(u_0)`.
    6. *Choice*: the sample, or their mean, whose predicted effect is nearest to what can be had
       of the plan is executed.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        hypotheses: names of :data:`~afm_rl.correction.hypotheses.HYPOTHESES`; all if None.
        rows: pairs that a hypothesis reads, K; None: 12, or more for more than eight actions.
        memory: pairs that are remembered, M.
        place: coordinates of the state in which the ground may differ; hypotheses by place are
            left out if there are none.
        place_scale: distance at which ground counts as other ground, in their unit.
        forgetting: :math:`\lambda`, of the hypotheses' losses.
        gate: in standard deviations of the model.
        samples: starting points of the flow.
        source_std: :math:`\sigma`, in half ranges.
        steps: midpoint steps.
        choose: the ``"best"`` sample by its predicted effect, or always their ``"mean"``.
        saturation: what gives way when a plan cannot be had in full, see
            :func:`~afm_rl.flow.saturation.saturate`.
        compile: run the tick as machine code, which is faster for a single
            mission; it is compiled once and kept in the cache. Where there is no compiler, the
            tick runs as it is. Results agree to rounding.
        cache: folder of compiled ticks.
        network: the network; None: the universal one that comes with the package.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> flow = ActionFlow(torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5]))
    >>> from afm_rl.dynamics import Dubins
    >>> memory, state = flow.begin(torch.zeros(3)), torch.zeros(3)
    >>> for _ in range(3):  # both motors are reversed
    ...     plan, box = torch.tensor([0.5, 0.2]), torch.tensor([[-1.0, -1.5], [1.0, 1.5]])
    ...     memory, found = flow.correct(memory, plan, Dubins(), box)
    ...     state = Dubins()(state, -found.executed)
    ...     memory = flow.observe(memory, state)
    >>> found.executed.round(decimals=1)
    tensor([-0.5000, -0.2000])
    """

    source_points: Tensor
    probes: Tensor
    penalty: Tensor

    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        hypotheses: Sequence[str] | None = None,
        rows: int | None = None,
        memory: int = 40,
        place: Sequence[int] = (),
        place_scale: float = 0.5,
        forgetting: float = 0.7,
        gate: float = 5.0,
        samples: int = 16,
        source_std: float = 0.3,
        steps: int = 1,
        choose: str = "best",
        saturation: str = "mixed",
        compile: bool = False,
        cache: str | Path = "~/.cache/afm_rl",
        network: AxisNetwork | None = None,
    ) -> None:
        size = len(torch.as_tensor(action_low))
        rows = max(ROWS, size + 4) if rows is None else check_count("corrector.rows", rows)
        super().__init__(action_low, action_high, gate, rows, memory, len(list(place)))
        self.place = list(place)
        self.place_scale = check_number(
            "corrector.place_scale", place_scale, low=0.0, open_low=True
        )
        hypotheses = list(HYPOTHESES) if hypotheses is None else hypotheses
        self.hypotheses = check_hypotheses(hypotheses, by_place=bool(self.place))
        chosen = [HYPOTHESES[name] for name in self.hypotheses]
        if self.memory < memory_of(chosen, rows):
            raise ConfigurationError(
                f"corrector.memory={memory!r}: expected at least {memory_of(chosen, rows)} for "
                f"{rows} rows and the hypotheses {', '.join(self.hypotheses)}"
            )
        self._rest = self.pair_size - 3 * size - 1
        self.by_place = any(h.near for h in chosen)
        self.forgetting = check_number("corrector.forgetting", forgetting, low=0.0, high=1.0)
        self.source_std = check_number("corrector.source_std", source_std, low=0.0)
        self.steps = check_count("corrector.steps", steps)
        self.choose = check_choice("corrector.choose", choose, ("best", "mean"))
        self.saturation = check_choice("corrector.saturation", saturation, MODES)
        self.compile, self.cache = check_flag("corrector.compile", compile), Path(cache)
        self.__dict__["_machine_code"] = None
        self.network = load_universal() if network is None else network
        never = 0.0 if IDENTITY in hypotheses else torch.inf
        penalty = [h.penalty for h in chosen] + [HYPOTHESES[IDENTITY].penalty + never]
        fixed = {
            "source_points": source_points_of(check_count("corrector.samples", samples), size),
            "probes": probes_of(size),
            "penalty": torch.tensor(penalty),
        }
        fixed |= {f"rows_{k}": part for k, part in lay_out(chosen, rows)._asdict().items()}
        for name, value in fixed.items():
            self.register_buffer(name, value, persistent=False)

    def shapes(self, state_size: int) -> dict[str, tuple[int, ...]]:
        """Return names and shapes, with the hypotheses' losses and predicted effects."""
        count = len(self.penalty)  # the identity is the last
        return {
            **super().shapes(state_size),
            "losses": (count,),
            "predicted": (count, self.action_size),
        }

    def correct(
        self, memory: Tensor, planned: Tensor, model: DynamicsModel, box: Tensor
    ) -> tuple[Tensor, Correction]:
        """Return the next memory, and what to execute for a planned action ``(*B, A)``."""
        with torch.no_grad():
            parts = self.unpack(memory, model.state_size)
            innovation = self.watch(parts, model)
            surprised = innovation > self.gate
            found = self.unchanged(planned, innovation, box)
            if bool(surprised.any()):
                use = rows_of(surprised)
                answer = self.answer(
                    {name: part[use] for name, part in parts.items()}, planned[use]
                )
                found = self._merge(found, parts, use, answer)
            parts |= {"planned": planned, "executed": found.executed}
            parts["misaligned"] = surprised.unsqueeze(-1).to(planned.dtype)
            return self.pack(parts), found

    @torch.inference_mode()
    def answer(self, parts: Fields, planned: Tensor) -> Answer:
        """Return the answer to plans ``(*B, A)`` of missions whose model is misaligned."""
        batch, kind = planned.shape[:-1], self.penalty.dtype
        given = [parts["pairs"], parts["losses"], parts["predicted"], parts["misaligned"]]
        given += [self.place_of(parts["state"]), self.normalise(planned)]
        given = [_flat(part, len(batch)).to(kind) for part in given]
        answer = self._compiled_tick(given)(*given) if self.compile else self.tick(*given)
        return Answer(*(part.view(*batch, *part.shape[1:]) for part in answer))

    def tick(
        self,
        pairs: Tensor,
        losses: Tensor,
        predicted: Tensor,
        misaligned: Tensor,
        place: Tensor,
        planned: Tensor,
    ) -> Answer:
        """Return the answer for B missions whose model is misaligned, in half ranges.

        Args:
            pairs: what is remembered, the newest last, ``(B, M, D)``.
            losses: of the hypotheses before the newest pair, ``(B, H + 1)``.
            predicted: effects that they predicted of it, ``(B, H + 1, A)``.
            misaligned: was anything predicted? ``(B, 1)``.
            place: where the missions are, ``(B, P)``.
            planned: u, ``(B, A)``.
        """
        losses = self.judge(pairs, losses, predicted, misaligned)
        belief = (losses + self.penalty).argmin(-1)
        encoded = self.encode(pairs, place)
        action, effect, spread, bounds = self.propose(self.pick(encoded, belief), planned)
        aligned = (belief == len(self.hypotheses)).unsqueeze(-1)
        action, effect = (torch.where(aligned, planned, part) for part in (action, effect))
        predicted = self.predict(encoded, pairs, action)
        return Answer(losses, predicted, aligned, action, effect, spread, bounds)

    def _compiled_tick(self, given: list[Tensor]) -> Callable[..., Sequence[Tensor]]:
        """Return :meth:`tick` as machine code, or as it is where that cannot be had."""
        if self._machine_code is None:
            two = [part[:1].repeat(2, *[1] * (part.dim() - 1)) for part in given]
            found = compile_tick(self.tick, self, two, self.cache)
            self.__dict__["_machine_code"] = self.tick if found is None else found
        return self._machine_code

    def judge(self, pairs: Tensor, losses: Tensor, predicted: Tensor, misaligned: Tensor) -> Tensor:
        """Return the hypotheses' losses ``(B, H + 1)`` after the newest pair."""
        size = self.action_size
        effective, std, valid, _ = pairs[:, -1:, size:].split([size, size, 1, self._rest], -1)
        tolerance = TOLERANCE**2
        miss = (predicted - effective).square()
        share = miss / ((miss + tolerance) * (1 + std.square() / tolerance))
        return self.forgetting * losses + valid.squeeze(-1) * misaligned * share.mean(-1)

    def encode(self, pairs: Tensor, place: Tensor) -> Encoded:
        """Return what the network reads under every hypothesis, B H sets of rows."""
        away = None
        if self.by_place:
            first = 3 * self.action_size + 2
            away = (pairs[..., first:] - place.unsqueeze(-2)).square().sum(-1)
            away = torch.where(pairs[..., first - 2] == 1.0, away, torch.inf)
        layout = Layout(*(getattr(self, f"rows_{name}") for name in Layout._fields))
        rows = read_rows(pairs, layout, self.action_size, away)
        rows = Rows(*(part.flatten(0, 1) for part in rows))
        return self.network.encode(rows, fit_experts(rows))

    def pick(self, encoded: Encoded, belief: Tensor) -> Encoded:
        """Return what is read under one hypothesis for each mission, ``(B,)``.

        The first stands in for the identity, which reads nothing.
        """
        count = len(self.hypotheses)
        first = torch.arange(belief.shape[0], device=belief.device) * count
        return encoded.pick(first + belief.where(belief < count, 0))

    def propose(self, known: Encoded, planned: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return action, predicted effect and spread ``(B, A)``, and bounds ``(B, 2, A)``.

        Args:
            known: what is read under the hypothesis that is believed.
            planned: ``(B, A)``, in half ranges.
        """
        plans = planned.unsqueeze(-2)
        velocity = partial(self.network.velocity, self.network.ask(known, plans, self.saturation))
        start = plans + self.source_std * self.source_points
        ends = midpoint(velocity, start, self.steps)
        mean, spread = ends.mean(-2, keepdim=True), ends.std(-2, correction=0)
        proposals = mean if self.choose == "mean" else torch.cat([mean, ends], -2)
        proposals = proposals.clamp(-1.0, 1.0)
        count = proposals.shape[-2]
        probes = self.probes.expand(planned.shape[0], -1, -1)
        foreseen = self.network.effect(known, torch.cat([proposals, probes], -2))
        effects, found = foreseen[:, :count], foreseen[:, count:]
        low, high = found.amin(-2), found.amax(-2)
        wanted = attainable(planned, low, high, self.saturation)
        best = nearest_of(effects, wanted, 0.5 * (high - low))
        chosen = torch.cat([proposals, effects], -1)
        chosen = chosen.gather(-2, best.expand(best.shape[0], 1, chosen.shape[-1])).squeeze(-2)
        action, effect = chosen.tensor_split(2, -1)
        return action, effect, spread, torch.stack([low, high], -2)

    def predict(self, encoded: Encoded, pairs: Tensor, executed: Tensor) -> Tensor:
        """Return the effects ``(B, H + 1, A)`` that the hypotheses predict of what acts now."""
        size = self.action_size
        sent = torch.cat([pairs[..., :size], executed.unsqueeze(-2)], -2)
        acted = sent.index_select(-2, self.memory - self.rows_delay)  # (B, H, A)
        effects = self.network.effect(encoded, acted.reshape(-1, 1, size)).view_as(acted)
        return torch.cat([effects, executed.unsqueeze(-2)], -2)

    def place_of(self, state: Tensor) -> Tensor:
        """Return where a state is, in the unit in which ground differs."""
        return state[..., self.place] / self.place_scale if self.place else state[..., :0]

    @property
    def signature(self) -> dict[str, object]:
        """What stored weights must agree in to be loaded."""
        return {"kind": "ActionFlow"}

    def training_loss(
        self,
        model: DynamicsModel,
        regime: Regime,
        states: States,
        count: int,
        generator: torch.Generator,
    ) -> Tensor:
        """Return the loss of ``count`` windows of a robot, see :func:`train_flow`."""
        drawn = self._draw(model, regime, states, count, generator)
        velocity, effect = flow_losses(self.network, drawn, self.saturation, generator)
        return (velocity + EFFECT_WEIGHT * effect).mean()

    @torch.no_grad()
    def held_out_error(
        self,
        model: DynamicsModel,
        regime: Regime,
        states: States,
        count: int,
        generator: torch.Generator,
    ) -> float:
        """Return the root mean square error of the action on new windows, in half ranges."""
        drawn = self._draw(model, regime, states, count, generator)
        known = self.network.encode(drawn.rows, fit_experts(drawn.rows))
        found = [self.propose(known, plan)[0] for plan in drawn.planned.unbind(1)]
        return float((torch.stack(found, 1) - drawn.intended).square().mean().sqrt())

    def _draw(self, model, regime, states, count, generator) -> Drawn:
        with torch.no_grad():
            size = (count, self.recent, PLANS)
            return draw_counterfactuals(
                self, model, regime, states, size, self.saturation, generator
            )

    def _merge(self, found: Correction, parts: Fields, use: Any, answer: Answer) -> Correction:
        """Put answers where ``use`` says so, in the units of the action; plans where they fail."""
        parts["losses"] = _put(parts["losses"], use, answer.losses)
        parts["predicted"] = _put(parts["predicted"], use, answer.predicted)
        sound = (answer.action + answer.effect).isfinite().all(-1, keepdim=True)
        planned, box = found.executed[use], found.bounds[use]
        unit = torch.stack([answer.action, answer.effect, *answer.bounds.unbind(-2)], -2)
        actions = torch.where(sound.unsqueeze(-1), self.denormalise(unit), planned.unsqueeze(-2))
        # Never a smaller box: the flow itself cuts what cannot be had.
        low = torch.minimum(actions[..., 2, :], box[..., 0, :])
        high = torch.maximum(actions[..., 3, :], box[..., 1, :])
        return Correction(
            _put(found.executed, use, actions[..., 0, :]),
            _put(found.predicted, use, actions[..., 1, :]),
            _put(found.spread, use, answer.spread * self.half_range),
            _put(found.bounds, use, torch.stack([low, high], -2)),
            found.innovation,
            _put(found.misaligned, use, ~answer.aligned.squeeze(-1)),
        )


def _flat(part: Tensor, lead: int) -> Tensor:
    """Return a part with its ``lead`` batch dimensions as one."""
    return part.unsqueeze(0) if lead == 0 else part.flatten(0, lead - 1) if lead > 1 else part


def _put(part: Tensor, use: Any, value: Tensor) -> Tensor:
    """Return a part with values where ``use`` says so."""
    if use is ...:
        return value.to(part.dtype, copy=True) if value.is_inference() else value.to(part.dtype)
    part = part.clone()
    part[use] = value.to(part.dtype)
    return part
