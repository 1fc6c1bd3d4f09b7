"""Action flow matching: one corrector for every robot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Unpack

import torch
from torch import Tensor

from afm_rl.compiling.machine_code import MachineCode, in_one_batch
from afm_rl.compiling.tracing import all_hold, somewhere
from afm_rl.correction.base import Correction, Fields
from afm_rl.correction.belief import Belief, mean_and_std, prior_of
from afm_rl.correction.delay import command_acting, delay_tables, likeliest_delay
from afm_rl.correction.flow_options import FlowOptions
from afm_rl.correction.hypotheses import (
    CHOICES,
    acting_of,
    choose,
    delayed,
)
from afm_rl.correction.network import AxisNetwork, load_universal
from afm_rl.correction.pairs import PairCorrector
from afm_rl.correction.tick import Tick
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_number
from afm_rl.options import filled, options

MOST_ODDS = 16.0  # what a long healthy time can make of the odds that nothing has changed
LEAST_NOISE = 0.02  # floor of the noise, a share of the largest recent command
LEAST_COMMAND = 0.25  # floor of that, a share of the largest action


class ActionFlow(PairCorrector):
    r"""The flow from noise around the planned action to the action that has its effect.

    A regime is described by pairs (executed, effective action), which mean the same for every
    model and robot (:func:`~afm_rl.dynamics.inverse.effective_action`). One network, trained once
    on regimes without any robot (:mod:`~afm_rl.correction.training.prior`), answers for any number
    of actions. At every tick (:meth:`correct`):

    1. *Measure*: the last transition gives a pair (u, v) and how sure v is.
    2. *Believe*: the hypotheses (:mod:`~afm_rl.correction.hypotheses`) that predicted v well gain
       weight, axis by axis (:mod:`~afm_rl.correction.belief`); the noise that none explains is
       learnt. The first is that *nothing has changed*. No loss is negative, so while its own is
       below its ``odds`` no other one can outweigh it: the planned action is executed, and nothing
       more is computed. When it is exceeded, the pairs from before are marked as old.
    3. *Flow*: straight paths :math:`x_\tau = (1-\tau)(u_0 + \sigma\epsilon) + \tau u_1` lead from
       around the plan :math:`u_0` to the inverse :math:`u_1 = T^{-1}(u_0)`.
    4. *Act*: of the plan, the flow's samples and the exact inverses of the fits, the action with
       the least expected loss under the belief is executed.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        network: the network; None: the universal one that comes with the package.

    Raises:
        ConfigurationError: for unknown hypotheses, ``noise`` below .02, or a ``memory``
            that is shorter than hypotheses look back.

    >>> flow = ActionFlow(torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5]))
    >>> from afm_rl.dynamics import Dubins
    >>> memory, state = flow.begin(torch.zeros(3)), torch.zeros(3)
    >>> for _ in range(8):  # both motors are reversed
    ...     plan, box = torch.tensor([0.5, 0.2]), torch.tensor([[-1.0, -1.5], [1.0, 1.5]])
    ...     memory, correction = flow.correct(memory, plan, Dubins(), box)
    ...     state = Dubins()(state, -correction.executed)
    ...     memory = flow.observe(memory, state)
    >>> correction.executed.round(decimals=1)
    tensor([-0.5000, -0.2000])
    """

    _machine_code: MachineCode
    log_prior: Tensor
    delays: Tensor
    constant_delays: Tensor
    acting: Tensor
    delay_likelihood: Tensor
    delay_log_prior: Tensor
    farthest: Tensor
    cause: Tensor
    healthy: Tensor
    episodic = (*PairCorrector.episodic, "under_way", "unmet")
    place_scale = 0.3
    """Distance to other ground, m."""

    @options("corrector")
    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        network: AxisNetwork | None = None,
        **options: Unpack[FlowOptions],
    ) -> None:
        settings: FlowOptions = filled(FlowOptions, "corrector", options)
        size, place = len(torch.as_tensor(action_low)), list(settings["place"])
        rows = max(12, size + 4) if settings["rows"] is None else settings["rows"]
        pairs: Any = {name: settings[name] for name in ("memory", "quiet", "delay", "home")}
        super().__init__(action_low, action_high, rows, place=len(place), **pairs)
        self.hypotheses = choose(
            settings["hypotheses"], bool(place), settings["plain"], settings["longest_delay"]
        )
        self.models = tuple(row.name for row in self.hypotheses)
        self.odds, self.discount = settings["odds"], settings["discount"]
        self.noise = check_number("corrector.noise", settings["noise"], low=LEAST_NOISE)
        self.noise_rate, self.tails, self.place = settings["noise_rate"], settings["tails"], place
        nominal, *others = self.hypotheses
        log_prior = torch.tensor([row.log_prior for row in others])
        prior = torch.cat([torch.full((1,), self.odds), log_prior.log_softmax(0)])
        # Of a model: its delay; -1: the one that is believed.
        delays = torch.tensor([-1 if row.follows_delay else row.delay for row in self.hypotheses])
        likelihood, delay_log_prior = delay_tables(delays, prior)
        pure = [row.kind in ("nominal", "delay") and not row.lag for row in self.hypotheses]
        self.longest_delay = max(delays.tolist())
        causes = [
            delayed(row.delay + self.delay) if row.delay else row.cause for row in self.hypotheses
        ]
        delays_in_words = [delayed(k + self.delay) for k in range(1, self.longest_delay + 1)]
        self.causes = tuple(dict.fromkeys([nominal.cause, *delays_in_words, *causes]))
        fixed = {
            "log_prior": log_prior,
            "acting": acting_of(self.hypotheses),
            "delays": delays,
            "constant_delays": torch.tensor(pure).nonzero().squeeze(-1),
            "delay_likelihood": likelihood,
            "delay_log_prior": delay_log_prior,
            "farthest": MOST_ODDS / (1 + (delays > 0).unsqueeze(-1).to(prior)),
            "healthy": torch.tensor(
                [float(row.kind in ("nominal", "healthy")) for row in self.hypotheses]
            ),
            "cause": torch.tensor([self.causes.index(cause) for cause in causes]),
        }
        for name, value in fixed.items():
            self.register_buffer(name, value, persistent=False)
        longest = rows + self.acting.shape[-1] - 1
        if self.memory < longest:
            raise ConfigurationError(
                f"corrector.memory={settings['memory']!r}: expected at least {longest} for {rows} "
                f"rows and the hypotheses "
                f"{', '.join(row.name for row in others if row.name in CHOICES)}"
            )
        self.compiles = settings["compile"]
        self.__dict__["_machine_code"] = MachineCode(self, settings["cache"])
        network = load_universal() if network is None else network
        flow: Any = (settings[name] for name in ("samples", "source_std", "steps", "saturation"))
        self.tick = Tick(network, self.scale, self.hypotheses, rows, *flow)

    @property
    def network(self) -> AxisNetwork:
        """The network that answers."""
        return self.tick.network

    @property
    def signature(self) -> dict[str, object]:
        """What stored weights must agree in to be loaded."""
        return {"kind": "ActionFlow"}

    def belief_in(self, memory: Tensor) -> Tensor:
        """Return how probable the :attr:`causes` are, by axis, ``(*B, C, A)``.

        Of a memory ``(*B, P)``. A model that follows the believed delay counts as that delay.

        >>> flow = ActionFlow(-torch.ones(1), torch.ones(1))
        >>> belief = flow.belief_in(flow.begin(torch.zeros(2)))
        >>> flow.causes[0], belief[0].item() > 0.7, belief.sum(-2).round(decimals=4)
        ('nothing has changed', True, tensor([1.]))
        """
        delay = self.unpack(memory, self.states_in(memory))["delay"].long()
        cause = torch.where((self.delays < 0) & (delay > 0), delay, self.cause)
        weights = self.weights_in(memory)
        none = weights.new_zeros(*weights.shape[:-2], len(self.causes), self.action_size)
        return none.scatter_add(-2, cause.unsqueeze(-1).expand_as(weights), weights)

    def cause_in(self, memory: Tensor) -> str:
        """Return the likeliest change that memories ``(*B, P)`` show, in words."""
        belief = self.belief_in(memory).movedim(-2, -1).flatten(0, -2).mean(0)
        cause = self.causes[1 + int(belief[1:].argmax())]
        if cause == "a recent change":
            return super().cause_in(memory)
        return cause + (": a delay that the model lacks?" if "late" in cause else "")

    def place_of(self, state: Tensor) -> Tensor:
        """Return where a state is, in the unit in which ground differs."""
        if not self.place:
            return state[..., :0]
        # One by one: a list of indices would be a constant, which no exported branch may hold.
        return torch.stack([state[..., k] for k in self.place], -1) / self.place_scale

    def shapes(self, state_size: int) -> dict[str, tuple[int, ...]]:
        """Return names and shapes, with the belief; its noise is the last part."""
        size, count = self.action_size, len(self.models)
        belief = {"losses": (count, size), "forecasts": (count, size), "noise": (size,)}
        # One row at least: no exported branch may return an empty tensor.
        waiting = max(1, self.longest_delay + self.delay)
        delay = {"delay": (1,), "under_way": (waiting, size), "unmet": (size,)}
        return {**super().shapes(state_size), "corrects": (1,), "usual": (1,), **delay, **belief}

    def begin(self, state: Tensor) -> Tensor:
        """Return the memory ``(*B, P)`` of missions that begin in ``state`` ``(*B, S)``."""
        parts = self.unpack(super().begin(state), state.shape[-1])
        return self.pack({**parts, "noise": torch.full_like(parts["noise"], self.noise)})

    def quiet_in(self, parts: Fields) -> Tensor:
        """Return up to which innovation a transition needs no explanation, ``(*B, 1)``.

        While plans are executed, what two of three transitions do not exceed, for a nearly exact
        model does not explain all of them. Zero while actions are corrected.
        """
        return self.quiet * (1 - parts["corrects"]) * parts["usual"].exp()

    def belief(self, parts: Fields) -> Belief:
        """Return the belief in the parts of a memory."""
        return Belief(parts["losses"], parts["forecasts"], parts["noise"])

    def floor(self, parts: Fields) -> Tensor:
        """Return the least noise ``(*B, A)``: effects nearer than that are all the same."""
        largest = parts["pairs"][..., : self.action_size].abs().amax(-2)
        return LEAST_NOISE * largest.clamp(LEAST_COMMAND, 1.0)

    def weights(self, parts: Fields) -> Tensor:
        """Return the probabilities of the models ``(*B, M, A)``."""
        noise = parts["noise"]
        prior = prior_of(self.log_prior.to(noise), self.odds, noise, self.floor(parts))
        belief = self.belief(parts)
        return belief.weights(belief.shared_prior(prior))

    def measure(self, memory: Tensor, model: DynamicsModel) -> Fields:
        """Return the parts of the memory with the newest pairs and the belief after them."""
        parts = super().measure(memory, model)
        newest, size = parts["pairs"][..., -1, :], self.action_size
        _, effect, std, valid, tail = newest.split([size, size, size, 1, self.tail], -1)
        loud = (tail[..., :1] > self.quiet_in(parts)).to(tail)
        learns = valid * (1 - parts["corrects"])
        usual = parts["usual"] + 0.05 * learns * (loud - 1 / 3)
        # What was decided holds until there is a surprise; but only here, where places differ.
        loud = torch.ones_like(loud) if self.place else torch.maximum(loud, parts["corrects"])
        parts |= {"usual": usual.clamp_min(0.0), "loud": loud}
        floor = self.floor(parts)
        constants = (self.discount, self.noise_rate, floor, self.tails, self.constant_delays)
        prior = prior_of(self.log_prior.to(floor), self.odds, parts["noise"], floor)
        belief = self.belief(parts).update(effect, std, valid, prior, *constants)
        belief = belief._replace(losses=self.share_losses(parts["losses"], belief.losses))
        misaligned = belief.losses[..., 0, :].amax(-1, keepdim=True) > self.odds
        before = parts["delay"].squeeze(-1).long()
        delay, losses = somewhere(
            misaligned.squeeze(-1) | (before > 0),
            lambda: self.delayed(belief, prior, before),
            [before, belief.losses],
        )
        parts["delay"], belief = delay.unsqueeze(-1).to(newest), belief._replace(losses=losses)

        def with_old_rows() -> list[Tensor]:
            begins = misaligned & ((parts["misaligned"] != 1.0) | self.is_sudden(parts))
            return [self.mark_old(parts["pairs"], begins)]

        (pairs,) = somewhere(misaligned.squeeze(-1), with_old_rows, [parts["pairs"]])
        misaligned = misaligned.to(newest)
        return parts | belief._asdict() | {"pairs": pairs, "misaligned": misaligned}

    def is_sudden(self, parts: Fields) -> Tensor:
        """Return whether a robot that was healthy, if not exactly as modelled, changes now.

        On some axis the newest effect, but not the one before, surprises all models by which it is
        healthy by five standard deviations of the learnt noise, ``(*B, 1)``.
        """
        size, pairs = self.action_size, parts["pairs"]
        sent, effect, std, _ = pairs[..., -2:, :].split([size, size, size, 1 + self.tail], -1)
        noise = 5 * torch.hypot(std, parts["noise"].unsqueeze(-2))
        miss = (effect[..., 1:, :] - parts["forecasts"]).abs()
        miss = torch.where(self.healthy.unsqueeze(-1) > 0, miss, torch.inf).amin(-2)
        before = (effect - sent)[..., 0, :].abs() > noise[..., 0, :]
        sudden = ((miss > noise[..., 1, :]) & ~before).any(-1, keepdim=True)
        if all_hold(~sudden):
            return sudden
        believed = (self.weights(parts) * self.healthy.unsqueeze(-1)).sum(-2)
        return sudden & (believed > 0.5).all(-1, keepdim=True)

    def share_losses(self, before: Tensor, losses: Tensor) -> Tensor:
        """Return the losses ``(*B, M, A)`` as models may have them until a change is known.

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

    def delays_now(self, delay: Tensor) -> Tensor:
        """Return the delays of all models ``(*B, M)`` while ``delay`` ``(*B)`` is believed."""
        return torch.where(self.delays < 0, delay.unsqueeze(-1), self.delays)

    def delayed(self, belief: Belief, prior: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        """Return the delay ``(*B)`` that is believed now, and the losses ``(*B, M, A)``.

        Zero while *nothing has changed* has a quarter of the probability or more on every axis: a
        first surprise says little about which delay it is. Models that follow a new one begin as
        good as the best that had it already.
        """
        tables = self.delay_likelihood, self.delay_log_prior
        delay = likeliest_delay(belief.weights(prior), before, *tables)
        unchanged = belief.weights(belief.shared_prior(prior))[..., 0, :] >= 0.25
        delay = torch.where(unchanged.all(-1) & (before == 0), 0, delay)
        has_it = (self.delays == delay.unsqueeze(-1)).unsqueeze(-1)
        # The last model explains the past by all delays: that says nothing for any one.
        best = torch.where(has_it, belief.losses, torch.inf)[..., :-1, :].amin(-2, keepdim=True)
        begin = (self.delays < 0) & (delay != before).unsqueeze(-1)
        return delay, torch.where(begin.unsqueeze(-1), best, belief.losses)

    def forecast_unchanged(self, parts: Fields, action: Tensor) -> Fields:
        """Return the parts if ``action`` ``(*B, A)`` is executed, and nothing has changed.

        All models then predict that commands act as they are sent, at once or delayed, so none can
        lose against *nothing has changed*; delayed ones keep what they predicted better, as in a
        cumulative sum, and are found as soon as there is a surprise. A delay that is believed also
        keeps what it predicted worse.
        """
        losses, delay = parts["losses"], parts["delay"].squeeze(-1).long()
        commands = self.commands(parts, action)
        acted = commands[..., : commands.shape[-2] - self.delay, :]
        acts = self.acting.to(acted) @ acted[..., acted.shape[-2] - self.acting.shape[-1] :, :]
        follows = (self.delays < 0).unsqueeze(-1)
        acts = torch.where(follows, command_acting(acted, delay).unsqueeze(-2), acts)
        believed = (self.delays_now(delay) == delay.unsqueeze(-1)) & (delay > 0).unsqueeze(-1)
        kept = believed.unsqueeze(-1) | (parts["misaligned"] == 1.0).unsqueeze(-1)
        best = torch.minimum(losses, losses[..., :1, :])
        newest = commands.shape[-2] - parts["under_way"].shape[-2]
        return parts | {
            "planned": action,
            "executed": action,
            "acting": self.denormalise(command_acting(acted, delay)),
            "forecasts": acts,
            "losses": torch.where(kept, losses, best),
            "corrects": torch.zeros_like(parts["corrects"]),
            "unmet": torch.zeros_like(action),
            "under_way": commands[..., newest:, :],
        }

    def commands(self, parts: Fields, executed: Tensor) -> Tensor:
        """Return all commands up to the present one, ``(*B, M + D + 1, A)``, in u.

        Those that have acted, those that are known to wait, and ``executed`` ``(*B, A)``.
        """
        acted = parts["pairs"][..., : self.action_size]
        ahead = torch.cat([parts["sent"], executed.unsqueeze(-2)], -2)
        return torch.cat([acted, self.normalise(ahead)], -2)

    def detect(self, memory: Tensor, planned: Tensor, model: DynamicsModel) -> tuple[Tensor, ...]:
        """Return the memory with the newest pair, and what it is if the plan is executed.

        Returns:
            Both, is the model misaligned? ``(*B)``, and the innovation ``(*B)``.
        """
        parts = self.measure(memory, model)
        innovation = parts["pairs"][..., -1, -self.tail]
        misaligned = (parts.pop("loud") * parts["misaligned"]).squeeze(-1) == 1.0
        memory = self.pack(parts)
        unchanged = parts if all_hold(misaligned) else self.forecast_unchanged(parts, planned)
        return memory, self.pack(unchanged), misaligned, innovation

    def decide(self, memory: Tensor, planned: Tensor, box: Tensor) -> tuple[Tensor, ...]:
        """Return the next memories, and what to execute, of B missions with a surprise.

        Args:
            memory: with the newest pair, ``(B, P)``.
            planned: ``(B, A)``.
            box: lowest and highest action, ``(B, 2, A)``.

        Returns:
            The next memory, and the parts of an :class:`Answer` but the last two.
        """
        parts = self.unpack(memory, self.states_in(memory))
        weights, delay = self.weights(parts), parts["delay"].squeeze(-1).long()
        rest = [self.normalise(x).to(self.tick.scale) for x in (parts["sent"], planned, box)]
        rest.append(parts["unmet"].to(self.tick.scale))
        answer = self.tick(*self._evidence(parts, weights), delay, *rest)
        executed, predicted, bounds = (
            self.denormalise(x.to(memory))
            for x in (answer.executed, answer.predicted, answer.bounds)
        )
        acting = self.denormalise((weights * answer.forecasts.to(memory)).sum(-2))
        parts |= {"planned": planned, "executed": executed, "acting": acting}
        parts["forecasts"] = answer.forecasts.to(memory)
        parts["under_way"] = answer.under_way.to(memory)
        parts["unmet"] = answer.unmet.to(memory)
        parts["corrects"] = answer.corrects.unsqueeze(-1).to(memory)
        spread = self.scale * answer.spread.to(memory)
        return self.pack(parts), executed, predicted, spread, bounds, answer.corrects

    def correct(
        self, memory: Tensor, planned: Tensor, model: DynamicsModel, box: Tensor
    ) -> tuple[Tensor, Correction]:
        """Return the next memory, and what to execute for a planned action ``(*B, A)``."""
        inside = planned.clamp(*box.unbind(-2))
        with torch.no_grad():
            memory, idle, misaligned, innovation = self._detect(memory, inside, model)
            plan = self.unchanged(inside, innovation, box)._replace(noise=self.noise_in(memory))
            as_planned = [idle, *plan[:4], plan.misaligned]
            decided = somewhere(misaligned, self._decide, as_planned, memory, planned, box)
            memory, executed, predicted, spread, bounds, corrects = decided
            answer = {"executed": executed, "predicted": predicted, "spread": spread}
            return memory, plan._replace(**answer, bounds=bounds, misaligned=corrects)

    def under_way(self, memory: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the state, the newest commands' effects, and how many of them are to come."""
        parts = self.unpack(memory, self.states_in(memory))
        steps = parts["delay"].squeeze(-1).long() + self.delay
        effects = parts["under_way"][..., : self.longest_delay + self.delay, :]
        return parts["state"], self.denormalise(effects), steps

    def noise_in(self, memory: Tensor) -> Tensor:
        """Return the noise that was learnt, ``(*B, A)``, in units of the action."""
        return self.scale * memory[..., -self.action_size :]

    def weights_in(self, memory: Tensor) -> Tensor:
        """Return how probable the :attr:`models` are, by axis, ``(*B, M, A)``."""
        parts = self.unpack(memory, self.states_in(memory))
        return self.weights(parts)

    def predict(
        self, memory: Tensor, action: Tensor, model: DynamicsModel
    ) -> tuple[Tensor, Tensor]:
        """Return the effect that an action ``(*B, A)`` will have, and its standard deviation.

        Both in units of the action, ``(*B, A)``: what the model would have to be given, so that it
        expects what the robot will do. With a delay it is what acts now, of earlier commands.

        Args:
            memory: up to the present state, ``(*B, P)``; it is not changed.
            action: what would be executed.
            model: the dynamics model as it is now.
        """
        with torch.no_grad():
            parts = self.measure(memory, model)
            parts.pop("loud")
            memory = self._with_forecasts(self.pack(parts), action)
            parts = self.unpack(memory, model.state_size)
            weights = self.weights(parts)
            mean, std = mean_and_std(parts["forecasts"], weights)
            return self.denormalise(mean), self.scale * torch.hypot(std, parts["noise"])

    def executing(
        self, memory: Tensor, planned: Tensor, executed: Tensor, misaligned: Tensor | None = None
    ) -> Tensor:
        """Return the memory with the actions that are planned and executed now, ``(*B, A)``."""
        return self._with_forecasts(
            super().executing(memory, planned, executed, misaligned), executed
        )

    def reported(self, memory: Tensor, given: Tensor) -> Tensor:
        """Return the memory with forecasts moved by what was given more than sent."""
        _, planned, sent = self.latest(memory)
        parts = self.unpack(super().reported(memory, given), self.states_in(memory))
        if self.delay:
            sent = self.unpack(memory, self.states_in(memory))["sent"][..., 0, :]
        difference = ((given - sent) / self.scale).unsqueeze(-2)
        return self.pack({**parts, "forecasts": parts["forecasts"] + difference})

    @torch.no_grad()
    def _with_forecasts(self, memory: Tensor, executed: Tensor) -> Tensor:
        """Return the memory with forecasts of what is executed, of all models if misaligned."""
        parts = self.unpack(memory, self.states_in(memory))
        misaligned = parts["misaligned"].squeeze(-1) == 1.0
        idle = self.forecast_unchanged(parts, executed)

        def by_models(memory: Tensor, executed: Tensor) -> Sequence[Tensor]:
            return self.forecast(self.unpack(memory, self.states_in(memory)), executed)

        unchanged = [idle["forecasts"], idle["under_way"]]
        forecasts, under_way = somewhere(misaligned, by_models, unchanged, memory, executed)
        return self.pack({**parts, "forecasts": forecasts, "under_way": under_way})

    def forecast(self, parts: Fields, executed: Tensor) -> tuple[Tensor, Tensor]:
        """Return the forecasts of all models, and what is under way."""
        ahead = torch.cat([parts["sent"], executed.unsqueeze(-2)], -2)
        evidence = *self._evidence(parts, self.weights(parts)), self.normalise(ahead)
        batch, delay = executed.shape[:-1], parts["delay"].reshape(-1).long()
        pairs, weights, noise, place, unit = (
            x.reshape(len(delay), *x.shape[len(batch) :]) for x in evidence
        )
        fits = self.tick.fit(pairs, noise, place, delay)
        effects = self.tick.forecast(fits, weights, delay, pairs, unit.to(pairs))
        forecasts, under_way = (x.view(*batch, *x.shape[1:]).to(executed) for x in effects)
        return forecasts, under_way

    def _evidence(self, parts: Fields, weights: Tensor) -> list[Tensor]:
        evidence = parts["pairs"], weights, parts["noise"], self.place_of(parts["state"])
        return [part.to(self.tick.scale) for part in evidence]

    @property
    def _as_machine_code(self) -> bool:
        return self.compiles and not torch.compiler.is_compiling()

    def observe(self, memory: Tensor, next_state: Tensor) -> Tensor:
        """Return the memory with the transition to ``next_state`` ``(*B, S)``."""
        if not self._as_machine_code:
            return super().observe(memory, next_state)
        return self._machine_code(PairCorrector.observe, memory, next_state)[0]

    def _detect(self, memory: Tensor, planned: Tensor, model: DynamicsModel) -> Sequence[Tensor]:
        # Machine code holds the model as it is now, one round of Gauss and Newton, and no
        # automatic derivative.
        derived = type(model).jacobian is DynamicsModel.jacobian
        if not self._as_machine_code or not model.affine or model.taught_in is not None or derived:
            return self.detect(memory, planned, model)
        return self._machine_code(ActionFlow.detect, memory, planned, model=model)

    @torch.inference_mode()
    def _decide(self, *arguments: Tensor) -> Sequence[Tensor]:
        if self._as_machine_code:
            return self._machine_code(ActionFlow.decide, *arguments)
        return in_one_batch(self.decide, *arguments)
