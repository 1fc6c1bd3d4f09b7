"""The correction as one function: what is remembered and a plan in, the command out."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.compiling.tracing import all_hold, in_one_batch, somewhere
from afm_rl.correction.achievable import attainable, extend
from afm_rl.correction.base import Fields, Layout
from afm_rl.correction.belief import Belief, mean_and_std, prior_of
from afm_rl.correction.delay import align, command_acting, delay_tables, likeliest_delay
from afm_rl.correction.experts import MISSES
from afm_rl.correction.groups import AsSent, LateGains, Lines, Maps, Pairs, Windows
from afm_rl.correction.hypotheses import KINDS, Hypothesis, acting_of
from afm_rl.correction.least_squares import precision_of
from afm_rl.correction.linear import Evidence
from afm_rl.correction.network import AxisNetwork, midpoint
from afm_rl.correction.pairs import PairCorrector

MOST_ODDS = 16.0  # what a long healthy time can make of the odds that nothing has changed
LEAST_NOISE = 0.02  # floor of the noise, a share of the largest recent command
LEAST_COMMAND = 0.25  # floor of that, a share of the largest action
AT_END = 1e-4  # shares of the largest action: a command so near an end of the box stands at it
LINEAR = ("line", "map", "late_gain")  # kinds that have an exact answer
WORTH = 0.02  # expected loss that another command than the plan has to save


class Plan(NamedTuple):
    """What is planned, and what is known of the moment; shares of the largest action."""

    action: Tensor
    """The plan, ``(*B, A)``."""
    box: Tensor
    """Lowest and highest action, ``(*B, 2, A)``."""
    limits: Tensor | None = None
    """Between which the command must be, whatever would be best, ``(*B, 2, A)``; None: the box."""
    waiting: Tensor | None = None
    """Commands that are known to act later, ``(*B, D, A)``; None: no delay is known."""
    place: Tensor | None = None
    """Where the robot is, ``(*B, G)``; None: all ground is alike."""

    @property
    def inside(self) -> Tensor:
        """The plan within the box and the limits."""
        inside = self.action.clamp(*self.box.unbind(-2))
        return inside if self.limits is None else inside.clamp(*self.limits.unbind(-2))


class Tick(NamedTuple):
    """What the core makes of a plan; actions and effects in shares of the largest action."""

    memory: Tensor
    """Of the next tick, ``(*B, P)``."""
    command: Tensor
    """What is executed, ``(*B, A)``."""
    predicted: Tensor
    """The effect that is expected of it, ``(*B, A)``."""
    spread: Tensor
    """Standard deviation of the flow's samples, ``(*B, A)``."""
    bounds: Tensor
    """Lowest and highest effect that an action may have, ``(*B, 2, A)``."""
    corrects: Tensor
    """Is it another command than the plan? ``(*B)``."""


class Answer(NamedTuple):
    """What the models make of plans, in shares of the largest action."""

    command: Tensor
    """The action, ``(B, A)``."""
    predicted: Tensor
    """The effect that is expected of it, ``(B, A)``."""
    spread: Tensor
    """Standard deviation of the proposals, ``(B, A)``."""
    bounds: Tensor
    """Lowest and highest effect that an action may have, ``(B, 2, A)``."""


class Models(NamedTuple):
    """The models of which an action is chosen: the likeliest of each group."""

    fits: list[Any]
    """What each group knows of them."""
    weights: Tensor
    """Their probabilities, ``(B, K, A)``."""


class Forecast(NamedTuple):
    """What the K models expect of C actions, ``(B, K, C, A)`` each."""

    effect: Tensor
    """Shares of the largest action."""
    variance: Tensor
    """Of the fits, in units of the noise."""

    def at(self, which: Tensor) -> Forecast:
        """Return the forecast of other actions, of which each axis has an index ``(B, N, A)``."""
        which = which.unsqueeze(1).expand(-1, self.effect.shape[1], -1, -1)
        return Forecast(self.effect.gather(2, which), self.variance.gather(2, which))


class Core(PairCorrector):
    """A tick as one pure function of tensors, :meth:`forward`, the same for any robot.

    :meth:`believe` is steps 1 and 2, :meth:`decide` steps 3 to 6. Nothing in here knows units, or
    asks a model of the dynamics: actions are shares of the largest one, and what a model makes of
    the last transition comes in as an effective action.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        network: the network.
        hypotheses: what may be the case; the first says that nothing has changed.
        rows: pairs of a context window.
        settings: those of :class:`~afm_rl.correction.flow_options.FlowOptions`.
    """

    groups: dict[str, Any]
    place_scale = 0.3
    """Distance to other ground, m."""
    acting: Tensor
    delays: Tensor
    constant_delays: Tensor
    any_delay: Tensor
    log_prior: Tensor
    delay_likelihood: Tensor
    delay_log_prior: Tensor
    farthest: Tensor
    healthy: Tensor
    points: Tensor
    probes: Tensor
    filters: Tensor
    filter_of_model: Tensor

    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        network: AxisNetwork,
        hypotheses: Sequence[Hypothesis],
        rows: int,
        settings: Any,
    ) -> None:
        place: list[int] = list(settings["place"])
        pairs = {name: settings[name] for name in ("memory", "quiet", "delay", "home")}
        super().__init__(action_low, action_high, rows, place=len(place), **pairs)
        size, self.place, self.rows = self.action_size, place, rows
        self.odds, self.discount = settings["odds"], settings["discount"]
        self.noise_rate, self.tails = settings["noise_rate"], settings["tails"]
        self.source_std, self.steps = settings["source_std"], settings["steps"]
        self.saturation = settings["saturation"]
        of_kind = {kind: [row for row in hypotheses if row.kind == kind] for kind in KINDS}
        groups: dict[str, Any] = {
            "as_sent": AsSent,
            "network": partial(Windows, network=network, rows=rows, size=size),
            "line": Lines,
            "map": Maps,
            "late_gain": partial(LateGains, rows=rows),
        }
        modules: Any = {kind: groups[kind](of_kind[kind]) for kind in KINDS if of_kind[kind]}
        self.groups = nn.ModuleDict(modules)  # type: ignore[assignment]
        self.hypotheses = tuple(row for kind in KINDS for row in of_kind[kind])
        self.counts = [len(group.hypotheses) for group in self.groups.values()]
        _, *others = self.hypotheses
        log_prior = torch.tensor([row.log_prior for row in others])
        prior = torch.cat([torch.full((1,), self.odds), log_prior.log_softmax(0)])
        # Of a model: its delay; -1: the one that is believed.
        delays = torch.tensor([-1 if row.follows_delay else row.delay for row in self.hypotheses])
        self.longest_delay = int(delays.max())
        pure = [row == hypotheses[0] or row.is_late and not row.lag for row in self.hypotheses]
        acting = acting_of(self.hypotheses)
        filters, which = filters_of(acting)
        likelihood, delay_log_prior = delay_tables(delays, prior)
        fixed = {
            "acting": acting,
            "delays": delays,
            "constant_delays": torch.tensor(pure).nonzero().squeeze(-1),
            "any_delay": torch.tensor([[row.any_delay] for row in self.hypotheses]),
            "log_prior": log_prior,
            "delay_likelihood": likelihood,
            "delay_log_prior": delay_log_prior,
            "farthest": MOST_ODDS / (1 + (delays > 0).unsqueeze(-1).to(prior)),
            "healthy": torch.tensor([[float(row.healthy)] for row in self.hypotheses]),
            "points": points_of(settings["samples"], size),
            "probes": probes_of(size),
            "filters": filters,
            "filter_of_model": nn.functional.one_hot(which).mT.to(filters),
        }
        for name, value in fixed.items():
            self.register_buffer(name, value, persistent=False)
        self.learnt = Layout.of(self.core_shapes())

    @property
    def network(self) -> AxisNetwork:
        """The network that answers."""
        return self.groups["network"].network

    def core_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return names and shapes of the fields that the core remembers, the last of a memory."""
        size, count = self.action_size, len(self.hypotheses)
        # One row at least: no exported branch may return an empty tensor.
        waiting = max(1, self.longest_delay + self.delay)
        return {
            "pairs": (self.memory, self.pair_size),
            "acting": (size,),
            "corrects": (1,),
            "usual": (1,),
            "delay": (1,),
            "under_way": (waiting, size),
            "unmet": (size,),
            "losses": (count, size),
            "forecasts": (count, size),
            "noise": (size,),
        }

    def shapes(self, state_size: int) -> dict[str, tuple[int, ...]]:
        """Return names and shapes of all fields; the core's come last."""
        return {**super().shapes(state_size), **self.core_shapes()}

    def forward(self, memory: Tensor, measured: Tensor, plan: Plan) -> Tick:
        """Return the next memory, and the command for a plan: the algorithm.

        Everything is a share of the largest action, counted from the action at rest.

        Args:
            memory: what is remembered, ``(*B, P)``.
            measured: the newest N pairs, mostly one: the command u that acted, the effective action
                v and its standard deviation, whether it counts (0 or 1), the innovation, and the
                place, ``(*B, N, 3 A + 2 + ...)``.
            plan: what is planned.
        """
        fields = self.learnt.unpack(memory)
        # Rows are chosen by it, so not even a damaged memory may have another.
        fields["delay"] = fields["delay"].nan_to_num().clamp(0, self.longest_delay)
        fields, changed = self.believe(fields, measured)
        inside, corrects = plan.inside, torch.zeros_like(changed)
        idle = fields if all_hold(changed) else self.as_planned(fields, inside, plan.waiting)
        none, memory = torch.zeros_like(inside), self.learnt.pack(fields)
        as_planned = [self.learnt.pack(idle), inside, inside, none, plan.box, corrects]
        return Tick(*somewhere(changed, self._decide, as_planned, memory, *plan))

    # Steps 1 and 2: of all missions at every tick.

    def believe(self, fields: Fields, measured: Tensor) -> tuple[Fields, Tensor]:
        """Return the memory with what the newest transition showed, and whether it is believed.

        Args:
            fields: what is remembered, ``(*B, ...)``.
            measured: the newest pairs, ``(*B, N, D)``.

        Returns:
            The fields, and where a change is believed and an action may have to be corrected,
            ``(*B)``.
        """
        # 1. Measure: the executed action and what it was worth are the newest pair.
        before, fields = self.misaligned(fields), self.remember(fields, measured)
        size, newest = self.action_size, fields["pairs"][..., -1, :]
        _, effect, std, valid, tail = newest.split([size, size, size, 1, self.tail], -1)

        # What two of three innovations do not exceed is usual: no model is quite exact.
        surprise = (tail[..., :1] > self.quiet_in(fields)).to(tail)
        learns = valid * (1 - fields["corrects"])
        usual = (fields["usual"] + 0.05 * learns * (surprise - 1 / 3)).clamp_min(0.0)

        # 2. Believe: each hypothesis loses by how far its forecast was off.
        floor = self.floor(fields)
        prior = prior_of(self.log_prior.to(floor), self.odds, fields["noise"], floor)
        belief = Belief(fields["losses"], fields["forecasts"], fields["noise"]).update(
            effect,
            std,
            valid,
            prior,
            self.discount,
            self.noise_rate,
            floor,
            self.tails,
            self.constant_delays,
            self.any_delay,
        )
        losses = self.share_losses(fields["losses"], belief.losses)
        misaligned = self.misaligned({"losses": losses})
        if not all_hold(~misaligned):  # a change begins: what was seen before it is old
            begins = misaligned & (~before | self.is_sudden(fields))
            fields["pairs"] = self.mark_old(fields["pairs"], begins)
        fields |= {"usual": usual, "losses": losses}
        delay = fields["delay"].squeeze(-1).long()
        if not all_hold(~misaligned.squeeze(-1) & (delay == 0)):
            fields |= self.delayed(belief._replace(losses=losses), prior, delay, misaligned)
        fields["noise"] = belief.noise

        # What was decided holds until there is a surprise; but only here, where places differ.
        again = torch.ones_like(surprise) if self.place else surprise.maximum(fields["corrects"])
        return fields, (misaligned & (again == 1.0)).squeeze(-1)

    def share_losses(self, before: Tensor, losses: Tensor) -> Tensor:
        """Return the losses ``(*B, H, A)`` as models may have them until a change is known.

        What surprises *nothing has changed* surprises all models that have yet to learn of it. One
        that foresaw it better, as some delay may by chance, leads by no more than the odds. And
        while nothing has changed, no model falls farther behind than a change may need: it may
        come at any step (fixed share: Herbster and Warmuth 1998, Machine Learning 32). A
        delay falls half as far: it is one for all axes, and where a model is not exact, axes whose
        commands stand still would hold against it what they showed before the change.
        """
        nothing = losses[..., :1, :]
        first = (before[..., :1, :] <= self.odds) & (nothing > self.odds)
        losses = torch.where(first, torch.maximum(losses, nothing - self.odds), losses)
        healthy = (nothing <= losses.amin(-2, keepdim=True) + self.odds).all(-1, keepdim=True)
        return torch.where(healthy, torch.minimum(losses, nothing + self.farthest), losses)

    def delayed(self, belief: Belief, prior: Tensor, before: Tensor, misaligned: Tensor) -> Fields:
        """Return the delay that is believed now, and the losses ``(*B, H, A)`` with it.

        Zero while *nothing has changed* has a quarter of the probability or more on every axis: a
        first surprise says little about which delay it is. Models that follow a new one begin as
        good as the best that had it already.

        Args:
            belief: after the newest effect.
            prior: log-odds of the hypotheses, ``(*B, H, A)``.
            before: the delay that was believed, ``(*B)``.
            misaligned: does anything but *nothing has changed* explain it? ``(*B, 1)``.
        """
        tables = self.delay_likelihood, self.delay_log_prior
        delay = likeliest_delay(belief.weights(prior), before, *tables)
        unchanged = belief.weights(belief.shared_prior(prior))[..., 0, :] >= 0.25
        delay = torch.where(unchanged.all(-1) & (before == 0), 0, delay)
        delay = torch.where(misaligned.squeeze(-1) | (before > 0), delay, before)
        # A model that explains the past by all delays says nothing for any one.
        has_it = (self.delays == delay.unsqueeze(-1)).unsqueeze(-1) & ~self.any_delay
        best = torch.where(has_it, belief.losses, torch.inf).amin(-2, keepdim=True)
        begins = (self.delays < 0) & (delay != before).unsqueeze(-1)
        losses = torch.where(begins.unsqueeze(-1), best, belief.losses)
        return {"delay": delay.unsqueeze(-1).to(losses), "losses": losses}

    def is_sudden(self, fields: Fields) -> Tensor:
        """Return whether a robot that was healthy, if not exactly as modelled, changes now.

        On some axis the newest effect, but not the one before, surprises all models by which it is
        healthy by five standard deviations of the learnt noise, ``(*B, 1)``.
        """
        size, pairs = self.action_size, fields["pairs"]
        sent, effect, std, _ = pairs[..., -2:, :].split([size, size, size, 1 + self.tail], -1)
        noise = 5 * torch.hypot(std, fields["noise"].unsqueeze(-2))
        miss = (effect[..., 1:, :] - fields["forecasts"]).abs()
        miss = torch.where(self.healthy > 0, miss, torch.inf).amin(-2)
        before = (effect - sent)[..., 0, :].abs() > noise[..., 0, :]
        sudden = ((miss > noise[..., 1, :]) & ~before).any(-1, keepdim=True)
        if all_hold(~sudden):
            return sudden
        believed = (self.weights(fields) * self.healthy).sum(-2)
        return sudden & (believed > 0.5).all(-1, keepdim=True)

    def as_planned(self, fields: Fields, action: Tensor, waiting: Tensor | None = None) -> Fields:
        """Return the fields if ``action`` ``(*B, A)`` is executed, and nothing has changed.

        All models then predict that commands act as they are sent, at once or delayed, so none can
        lose against *nothing has changed*; delayed ones keep what they predicted better, as in a
        cumulative sum, and are found as soon as there is a surprise. A delay that is believed also
        keeps what it predicted worse.
        """
        losses, delay = fields["losses"], fields["delay"].long()
        commands, acts, believed = self.acting_now(fields, action, waiting)
        has_it = ((self.delays == delay) | (self.delays < 0)) & (delay > 0)
        kept = (has_it | self.misaligned(fields)).unsqueeze(-1)
        return fields | {
            "acting": believed,
            "forecasts": acts,
            "losses": torch.where(kept, losses, torch.minimum(losses, losses[..., :1, :])),
            "corrects": torch.zeros_like(fields["corrects"]),
            "unmet": torch.zeros_like(action),
            "under_way": self.newest_of(commands),
        }

    # Steps 3 to 6: of B missions in which something may have changed.

    def decide(self, memory: Tensor, plan: Plan) -> Tick:
        """Return the next memories, and what to execute.

        Args:
            memory: with the newest pair, ``(B, P)``.
            plan: with tensors ``(B, ...)``.
        """
        fields = self.learnt.unpack(memory)
        weights, exact = self.weights(fields), self.points.dtype
        plan = Plan._make(numbers if numbers is None else numbers.to(exact) for numbers in plan)
        inside, shares = plan.inside, weights.to(exact)

        # 3. Fit each hypothesis to the pairs.
        fits = self.fit(fields, plan.place)

        # While it is healthy by more than half of the probability, the plan is executed to the bit.
        changed = (shares * self.healthy).sum(1) < 0.5
        answer = Answer(inside, inside, torch.zeros_like(inside), plan.box)
        if not all_hold(~changed):
            answer = self.answer(fields, fits, shares, plan, changed)
        command, predicted, spread, bounds = answer

        # What the box could not give is kept for the next plan.
        low, high = plan.box.unbind(1)  # one action alone, where nothing is to be corrected
        at_end = (low < high) & ((command <= low + AT_END) | (command >= high - AT_END))
        unmet = torch.where(changed & at_end, plan.action - predicted, 0.0).clamp(-1.0, 1.0)

        # What every hypothesis expects of the command is compared with what it will do.
        command = command.to(memory)
        forecasts, under_way = self.forecast(fields, fits, shares, command, plan.waiting)
        corrects = changed.any(-1)
        fields |= {
            "acting": (weights * forecasts.to(memory)).sum(-2),
            "forecasts": forecasts.to(memory),
            "under_way": under_way.to(memory),
            "unmet": unmet.to(memory),
            "corrects": corrects.unsqueeze(-1).to(memory),
        }
        told = (numbers.to(memory) for numbers in (predicted, spread, bounds))
        return Tick._make([self.learnt.pack(fields), command, *told, corrects])

    @torch.inference_mode()
    def _decide(self, memory: Tensor, *plan: Tensor) -> Sequence[Tensor]:
        return in_one_batch(lambda memory, *plan: self.decide(memory, Plan(*plan)), memory, *plan)

    def answer(
        self,
        fields: Fields,
        fits: Sequence[Any],
        weights: Tensor,
        plan: Plan,
        changed: Tensor,
    ) -> Answer:
        """Return the answers to plans: steps 4 to 6, where axes have ``changed``."""
        planned, box, limits, waiting, _ = plan
        noise, unmet = (fields[name].to(planned) for name in ("noise", "unmet"))
        sent = fields["pairs"][..., : self.action_size].to(planned)
        models = self.likeliest(fits, weights)

        # 4. Flow: propose actions for the plan. Where commands alternate, what the box could not
        # give of the last plan is added to one that goes back, so that plans keep their mean.
        turns = torch.cat([sent[:, -5:], planned.unsqueeze(1)], 1).diff(dim=1)
        alternate = (turns[:, 1:] * turns[:, :-1] < 0).all(1)
        back = (planned - fields["acting"].to(planned)) * unmet < 0
        asked = planned + torch.where(alternate & back, unmet, 0.0)
        proposals, spread = self.propose(models, asked, box)

        # 5. Decide: of the proposals, the one with the least expected loss.
        expected = self.expect(models, proposals)
        reach = self.reach(models, expected.effect)
        low, high = reach.unbind(1)
        wanted = attainable(asked, low, high, self.saturation)
        bounds = extend(reach, box, sent.amax(1) - sent.amin(1))
        action, effects = self.choose(models, proposals, expected, wanted, noise)

        # 6. Act, within the limits: a slow actuator, if that is the likeliest, is led.
        lag = (self.filter_of_model @ weights).argmax(1)
        if limits is not None or not all_hold(lag == 0):
            before = sent if waiting is None else torch.cat([sent, waiting.to(sent)], 1)
            action, acts = self.lead(action, lag, before, box if limits is None else limits)
            effects = self.expect(models, acts.unsqueeze(1)).effect.squeeze(2)

        inside, changed = plan.inside, changed & action.isfinite().all(-1, True)
        effects = torch.where(changed.unsqueeze(1), effects, expected.effect[:, :, 0])
        command, predicted = torch.where(changed, action, inside), (models.weights * effects).sum(1)
        active = changed.any(-1, keepdim=True)  # elsewhere the plan, and what it says
        predicted = torch.where(active, predicted, inside)
        bounds = torch.where(active.unsqueeze(-1), bounds, box)
        return Answer(command, predicted, torch.where(active, spread, 0.0), bounds)

    def fit(self, fields: Fields, place: Tensor | None = None) -> list[Any]:
        """Return what each group makes of the memories ``(B, ...)``, in places ``(B, G)``."""
        size, exact = self.action_size, self.points.dtype
        rows, noise = fields["pairs"].to(exact), fields["noise"].to(exact)
        aligned = align(rows, fields["delay"].reshape(-1).long(), size)
        acted, effect, std, valid = aligned[..., : 3 * size + 1].split([size, size, size, 1], -1)
        recent = (valid == 1.0).to(rows)
        weight = precision_of(torch.hypot(std, noise.unsqueeze(1)), recent)
        sent, acted, effect, weight = (
            column.mT.double() for column in (rows[..., :size], acted, effect, weight)
        )
        evidence = Evidence(sent, acted, effect, weight, noise.double())
        pairs = Pairs(aligned, None if place is None else place.to(exact))
        return [group.fit(evidence, pairs) for group in self.groups.values()]

    def foreseen(
        self, fields: Fields, action: Tensor, waiting: Tensor | None, place: Tensor | None
    ) -> Fields:
        """Return the fields if ``action`` ``(*B, A)`` is executed, whatever is believed."""
        idle = self.as_planned(fields, action, waiting)
        unchanged = [idle["forecasts"], idle["under_way"]]
        given = self.learnt.pack(fields), action, waiting, place
        work, misaligned = partial(in_one_batch, self._foreseen), self.misaligned(fields)
        forecasts, under_way = somewhere(misaligned.squeeze(-1), work, unchanged, *given)
        return idle | {"forecasts": forecasts, "under_way": under_way}

    def _foreseen(
        self, memory: Tensor, action: Tensor, waiting: Tensor | None, place: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return the forecasts of all models, and what is under way, of memories ``(B, P)``."""
        fields = self.learnt.unpack(memory)
        weights, fits = self.weights(fields).to(self.points), self.fit(fields, place)
        return self.forecast(fields, fits, weights, action, waiting)

    def likeliest(self, fits: Sequence[Any], weights: Tensor) -> Models:
        """Return the models of which an action is chosen."""
        of_group = zip(self.groups.values(), fits, weights.split(self.counts, 1), strict=True)
        chosen, shares = zip(*(group.likeliest(*fit) for group, *fit in of_group), strict=True)
        return Models(list(chosen), torch.cat(shares, 1))

    def propose(self, models: Models, planned: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions ``(B, C, A)``, the first the planned one, and the samples' deviation.

        The flow's samples, the exact answers of all fits, and a few actions from all over the box.
        """
        plan, (least, most) = planned.unsqueeze(1), box.split(1, 1)
        fits = dict(zip(self.groups, models.fits, strict=True))
        code = self.network.ask(fits["network"], plan, self.saturation)
        start = plan + self.source_std * self.points
        ends = midpoint(partial(self.network.velocity, code), start, self.steps)
        mean, spread = ends.mean(1, keepdim=True), ends.std(1, correction=0)
        of_experts = code.answers[..., 0, :MISSES].mT
        exact = [fit.invert(planned) for kind, fit in fits.items() if kind in LINEAR]
        probes = torch.lerp(least, most, 0.5 * (self.probes + 1))
        proposals = torch.cat([plan, mean, ends, of_experts, *exact, probes], 1)
        return proposals.clamp(least, most), spread

    def expect(self, models: Models, actions: Tensor) -> Forecast:
        """Return what every model expects of actions ``(B, C, A)``."""
        groups = zip(self.groups.values(), models.fits, strict=True)
        of_each = [group.forecast(fit, actions) for group, fit in groups]
        return Forecast(*(torch.cat(of_group, 1) for of_group in zip(*of_each, strict=True)))

    def reach(self, models: Models, effects: Tensor) -> Tensor:
        """Return the lowest and highest effects that actions may have, ``(B, 2, A)``.

        Optimistic bounds, mean plus or minus one standard deviation over the models, so that the
        planner explores.
        """
        weights = models.weights.unsqueeze(2)
        mean, std = mean_and_std(effects.transpose(1, 2), weights.transpose(1, 2))
        return torch.stack([(mean - std).amin(1), (mean + std).amax(1)], 1)

    def choose(
        self, models: Models, proposals: Tensor, expected: Forecast, wanted: Tensor, noise: Tensor
    ) -> tuple[Tensor, Tensor]:
        r"""Return the actions ``(B, A)`` with the least expected loss, and what models expect.

        .. math:: u_a = \operatorname{argmin}_u \sum_h w_{ha}
                  \log\Big(1 + \frac{(T_{ha}(u) - u^*_a)^2}{s_a^2}\Big)

        with the wanted effect :math:`u^*`, the forecasts T and the probabilities w of the models,
        over the proposals that the evidence reaches (:meth:`rate`), axis by axis, if these actions
        together are no worse than the best proposal as a whole, as they may be where one command
        moves several axes. The loss averages models that differ by less than the noise s, and
        decides between those that differ by more: half of two opposite answers would do nothing,
        and tell nothing. So would small actions in noise: the plan is kept where they save less
        than .02 of expected loss.
        """
        loss, by_axis, together = self.rate(models, proposals, expected, wanted, noise)
        cost = torch.cat([loss[:, :1] - WORTH, loss[:, 1:]], 1)
        each = torch.where(by_axis, cost, torch.inf).argmin(1, keepdim=True)
        least, joint = torch.where(together, cost.sum(-1, True), torch.inf).min(1, True)
        joint = joint.expand_as(each)
        action, effect = proposals.gather(1, joint), expected.at(joint).effect
        if not all_hold(each == joint):
            which = torch.cat([torch.zeros_like(each), each], 1)
            apart = proposals.gather(1, which)
            forecast = self._reconsidered(models, expected.at(which), apart)
            loss, _, together = self.rate(models, apart, forecast, wanted, noise)
            better = together[:, 1:] & (loss[:, 1:].sum(-1, keepdim=True) <= least + 1e-6)
            action = torch.where(better, apart[:, 1:], action)
            effect = torch.where(better.unsqueeze(1), forecast.effect[:, :, 1:], effect)
        return action.squeeze(1), effect.squeeze(2)

    def _reconsidered(self, models: Models, forecast: Forecast, actions: Tensor) -> Forecast:
        """Return a forecast with what groups that mix axes expect of actions ``(B, C, A)``."""
        counts = [group.models for group in self.groups.values()]
        of_groups = zip(*(of_models.split(counts, 1) for of_models in forecast), strict=True)
        groups = zip(self.groups.values(), models.fits, of_groups, strict=True)
        of_each = [
            group.forecast(fit, actions) if group.mixes_axes else as_before
            for group, fit, as_before in groups
        ]
        return Forecast(*(torch.cat(of_group, 1) for of_group in zip(*of_each, strict=True)))

    def rate(
        self, models: Models, actions: Tensor, expected: Forecast, wanted: Tensor, noise: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        r"""Return the expected loss of actions ``(B, C, A)``, and which the evidence reaches.

        It does if half of the probability is with models that promise at least twice their standard
        deviation :math:`\sigma`: that the miss is so much less than that of the first
        action, which is the plan :math:`u_0`,

        .. math:: \sum_h w_{ha} \big[\,|T_{ha}(u_0) - u^*_a| - |T_{ha}(u) - u^*_a|
                  \ge 2 \sigma_{ha}(u)\big] \ge \tfrac12 \sum_h w_{ha},

        axis by axis ``(B, C, A)``; and together ``(B, C, 1)``, where axes count as far as they
        move away from the plan. A line through commands that were nearly alike explains them, and
        knows nothing of others: where :math:`\sigma` is half of the largest action, a model has no
        part in the sums.
        """
        weights, square = models.weights.unsqueeze(2), noise[:, None, None].square()
        misses = (expected.effect - wanted[:, None, None]).square()
        loss = (weights * (misses / square).log1p()).sum(1)
        misses, std = misses.sqrt(), (expected.variance * square).sqrt()
        promised = misses[:, :, :1] - misses >= 2 * std - 1e-6
        excess = weights * (std < 0.5) * (promised.to(weights) - 0.5)
        excess, moved = excess.sum(1) - 1e-6, (actions - actions[:, :1]).abs()
        return loss, (excess > 0) | (moved == 0), (excess * moved).sum(-1, keepdim=True) >= 0

    def lead(self, acts: Tensor, lag: Tensor, sent: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
        r"""Return the commands ``(B, A)`` after which ``acts`` acts, and what acts after them.

        .. math:: u = (v - (1 - c) \bar u) / c

        as far as the box allows, where the actuator makes :math:`c u + (1 - c) \bar u` of this
        command and those before it.

        Args:
            acts: v, what should act, ``(B, A)``.
            lag: by which filter commands act, ``(B, A)``.
            sent: commands until now, the newest last, ``(B, N, A)``.
            box: lowest and highest action, ``(B, 2, A)``.
        """
        shares = self.filters[lag]  # (B, A, L)
        before = sent[:, sent.shape[1] - shares.shape[-1] + 1 :].mT
        past, share = (shares[..., :-1] * before).sum(-1), shares[..., -1]
        action = ((acts - past) / share).clamp(box[:, 0], box[:, 1])
        return action, share * action + past

    def forecast(
        self,
        fields: Fields,
        fits: Sequence[Any],
        weights: Tensor,
        executed: Tensor,
        waiting: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return the effects ``(B, H, A)`` that all hypotheses expect of what acts now.

        And those ``(B, N, A)`` that the newest commands have or will have, by the models with the
        present delay; the commands themselves where none is to come.
        """
        commands, acts, _ = self.acting_now(fields, executed, waiting)
        of_groups = acts.to(weights).split(self.counts, 1)
        of_group = zip(self.groups.values(), fits, of_groups, strict=True)
        forecasts = torch.cat([group.expect(*fit) for group, *fit in of_group], 1)
        newest, delay = self.newest_of(commands).to(weights), fields["delay"].long()
        to_come = delay + self.delay > 0
        if all_hold(~to_come):
            return forecasts, newest
        has_delay = ((self.delays < 0) | (self.delays == delay)).unsqueeze(-1)
        models = self.likeliest(fits, torch.where(has_delay, weights.clamp_min(1e-9), 0.0))
        shares = models.weights / models.weights.sum(1, keepdim=True)
        effects = (shares.unsqueeze(2) * self.expect(models, newest).effect).sum(1)
        return forecasts, torch.where(to_come.unsqueeze(-1), effects, newest)

    # What the steps share.

    def acting_now(
        self, fields: Fields, executed: Tensor, waiting: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return all commands, those that act now by each model, and by the delay believed.

        All up to the present one, ``executed`` ``(*B, A)``: those that have acted, and those that
        are known to wait. ``(*B, M + D + 1, A)``, ``(*B, H, A)`` and ``(*B, A)``.
        """
        sent = fields["pairs"][..., : self.action_size]
        known = [] if waiting is None else [waiting]
        commands = torch.cat([sent, *known, executed.unsqueeze(-2)], -2)
        acted = commands[..., : commands.shape[-2] - self.delay, :]
        newest = acted[..., acted.shape[-2] - self.acting.shape[-1] :, :]
        believed = command_acting(acted, fields["delay"].squeeze(-1).long())
        follows = (self.delays < 0).unsqueeze(-1)
        acts = torch.where(follows, believed.unsqueeze(-2), self.acting.to(acted) @ newest)
        return commands, acts, believed

    def newest_of(self, commands: Tensor) -> Tensor:
        """Return the commands that may be under way, of all ``(*B, N, A)``, the newest last."""
        # One at least: no exported branch may return an empty tensor.
        return commands[..., -max(1, self.longest_delay + self.delay) :, :]

    def place_of(self, state: Tensor) -> Tensor:
        """Return where states are, in the unit in which ground differs."""
        if not self.place:
            return state[..., :0]
        # One by one: a list of indices would be a constant, which no exported branch may hold.
        return torch.stack([state[..., k] for k in self.place], -1) / self.place_scale

    def misaligned(self, fields: Fields) -> Tensor:
        """Return whether *nothing has changed* has lost its odds on some axis, ``(*B, 1)``."""
        return fields["losses"][..., 0, :].amax(-1, keepdim=True) > self.odds

    def quiet_in(self, fields: Fields) -> Tensor:
        """Return up to which innovation a transition needs no explanation, ``(*B, 1)``.

        While plans are executed, what two of three transitions do not exceed, for a nearly exact
        model does not explain all of them. Zero while actions are corrected.
        """
        return self.quiet * (1 - fields["corrects"]) * fields["usual"].exp()

    def floor(self, fields: Fields) -> Tensor:
        """Return the least noise ``(*B, A)``: effects nearer than that are all the same."""
        largest = fields["pairs"][..., : self.action_size].abs().amax(-2)
        return LEAST_NOISE * largest.clamp(LEAST_COMMAND, 1.0)

    def weights(self, fields: Fields) -> Tensor:
        """Return the probabilities of the hypotheses ``(*B, H, A)``."""
        noise = fields["noise"]
        prior = prior_of(self.log_prior.to(noise), self.odds, noise, self.floor(fields))
        belief = Belief(fields["losses"], fields["forecasts"], noise)
        return belief.weights(belief.shared_prior(prior))


def filters_of(acting: Tensor) -> tuple[Tensor, Tensor]:
    """Return the ways ``(F, L)`` in which actuators are slow, and that of each model ``(M,)``.

    The first is that they are not, as where commands are late and no more.

    >>> filters_of(torch.tensor([[0.0, 1.0], [1.0, 0.0], [0.4, 0.6]]))
    (tensor([[0.0000, 1.0000],
            [0.4000, 0.6000]]), tensor([0, 0, 1]))
    """
    newest = torch.zeros_like(acting)
    newest[:, -1] = 1.0
    slow = ((acting > 0).sum(-1, keepdim=True) > 1) & (acting[:, -1:] > 0)
    return torch.where(slow, acting, newest).unique(dim=0, return_inverse=True)


def points_of(count: int, size: int) -> Tensor:
    """Return normal points ``(count, A)``, the same ones always; each has its opposite."""
    half = torch.randn((count + 1) // 2, size, generator=torch.Generator().manual_seed(0))
    return torch.cat([half, -half])[:count]


def probes_of(size: int, count: int = 32) -> Tensor:
    """Return actions ``(P, A)`` in [-1, 1]: ends of the axes, and between them.

    >>> probes_of(1)[:2].tolist()
    [[1.0], [-1.0]]
    """
    ends = torch.cat([torch.eye(size), -torch.eye(size)])
    inner = torch.quasirandom.SobolEngine(size).draw(max(1, count - 2 * size))
    return torch.cat([ends, 2 * inner - 1])
