"""A corrector that holds a belief over models of the actuators."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.compiling.tracing import all_hold, somewhere
from afm_rl.correction.base import Correction, Fields
from afm_rl.correction.belief import Belief, mean_and_std, prior_of
from afm_rl.correction.late import ago, delay_tables, steps_late
from afm_rl.correction.pairs import PairCorrector
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import check_number


class Answer(NamedTuple):
    """What the models make of plans, in units of the action."""

    executed: Tensor
    """The action, ``(B, A)``."""
    predicted: Tensor
    """The effect that is expected of it, ``(B, A)``."""
    spread: Tensor
    """Standard deviation of the proposals, ``(B, A)``."""
    bounds: Tensor
    """Lowest and highest effect that an action may have, ``(B, 2, A)``."""
    corrects: Tensor
    """Is any model believed more than that nothing has changed? ``(B)``."""
    forecasts: Tensor
    """The effects that the models expect of what acts now, shares of the largest action,
    ``(B, M, A)``; the first is that of *nothing has changed*."""
    under_way: Tensor
    """The effects that the newest commands have or will have, likewise, ``(B, K + D, A)``."""


class Believer(PairCorrector):
    r"""A corrector that believes in models of the actuators as far as they predict.

    It holds a :class:`~afm_rl.correction.belief.Belief` over M models of the pairs that it
    remembers; the first is *nothing has changed*. No loss is negative, so while that model's own
    loss is below its ``odds`` no other one can outweigh it: then the planned action is executed,
    and nothing more is computed. When it is exceeded, the pairs from before are marked as old.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        recent: newest transitions, R: a model that learns is asked about them again at every step.
        memory: pairs that are remembered.
        models: names of the models but the first.
        place: number of state coordinates that are remembered with a pair.
        worth: prior log-odds of these models among themselves; all alike if None.
        acting: what commands weigh in what acts now by all M + 1 models, by age, the oldest first,
            ``(M + 1, L)``: the newest one by all of them, if None.
        follows: which of the M + 1 models take any delay that is believed; none if None.
        odds: prior log-odds of *nothing has changed* against all other models together; a larger
            one acts later, and a legged robot that is reversed falls.
        most_odds: what evidence for *nothing has changed* can make of them: what was learnt in a
            thousand healthy steps must not hide a change for longer than a few.
        discount: of the losses; .95 looks back on twenty steps.
        noise: standard deviation that no model explains, at first, a share of the largest action.
        noise_rate: share of its square that is renewed at every step.
        least_noise: its floor, a share of the largest command that is remembered: effects nearer
            than that are all the same. In more noise a belief looks back longer.
        least_command: what the largest command counts as at least, a share of the largest action: a
            quadrotor that hovers needs a hundredth of its moments.
        quiet: normalised innovation up to which a transition needs no explanation.
        delay: steps that are known, D at most; those of the models come on top.
    """

    worth: Tensor
    delays: Tensor
    acting: Tensor
    told: Tensor
    first: Tensor

    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        recent: int,
        memory: int,
        models: Sequence[str],
        place: int = 0,
        worth: Sequence[float] | None = None,
        acting: Tensor | None = None,
        follows: Sequence[bool] | None = None,
        odds: float = 1.0,
        most_odds: float = 16.0,
        discount: float = 0.95,
        noise: float = 0.05,
        noise_rate: float = 0.1,
        least_noise: float = 0.02,
        least_command: float = 0.25,
        quiet: float = 1.0,
        tails: float = 1.0,
        delay: int | Sequence[int] = 0,
    ) -> None:
        super().__init__(action_low, action_high, recent, memory, place, quiet, delay)
        self.models = ("nothing has changed", *models)
        self.odds = check_number("corrector.odds", odds, low=0.0)
        self.most_odds = check_number("corrector.most_odds", most_odds, low=0.0)
        self.discount = check_number("corrector.discount", discount, low=0.0, high=1.0)
        self.noise_rate = check_number("corrector.noise_rate", noise_rate, low=0.0, high=1.0)
        self.least_noise = check_number(
            "corrector.least_noise", least_noise, low=0.0, open_low=True
        )
        self.noise = check_number("corrector.noise", noise, low=self.least_noise)
        self.least_command = check_number(
            "corrector.least_command", least_command, low=0.0, high=1.0, open_low=True
        )
        self.tails = check_number("corrector.tails", tails, low=0.0, open_low=True)
        among = torch.zeros(len(models)) if worth is None else torch.tensor(worth)
        self.register_buffer("worth", among, persistent=False)
        acting = torch.ones(len(self.models), 1) if acting is None else acting
        self.register_buffer("acting", acting, persistent=False)
        # Of a model: the age of the command that weighs most; -1: the delay that is believed.
        late = acting.shape[-1] - 1 - acting.argmax(-1)
        late = late if follows is None else late.masked_fill(torch.tensor(follows), -1)
        self.register_buffer("delays", late, persistent=False)
        prior = torch.cat([torch.full((1,), self.odds), among.log_softmax(0)])
        for name, table in zip(("told", "first"), delay_tables(late, prior), strict=True):
            self.register_buffer(name, table, persistent=False)
        self.most_late = max(late.tolist())

    def shapes(self, state_size: int) -> dict[str, tuple[int, ...]]:
        """Return names and shapes, with the belief; its noise is the last part."""
        size, count = self.action_size, len(self.models)
        belief = {"losses": (count, size), "forecasts": (count, size), "noise": (size,)}
        late = {"late": (1,), "under_way": (self.most_late + self.delay, size)}
        return {**super().shapes(state_size), **late, **belief}

    def begin(self, state: Tensor) -> Tensor:
        """Return the memory ``(*B, P)`` of missions that begin in ``state`` ``(*B, S)``."""
        parts = self.unpack(super().begin(state), state.shape[-1])
        return self.pack({**parts, "noise": torch.full_like(parts["noise"], self.noise)})

    def belief(self, parts: Fields) -> Belief:
        """Return the belief in the parts of a memory."""
        return Belief(parts["losses"], parts["forecasts"], parts["noise"])

    def floor(self, parts: Fields) -> Tensor:
        """Return the least noise ``(*B, A)``: effects nearer than that are all the same."""
        largest = parts["pairs"][..., : self.action_size].abs().amax(-2)
        return self.least_noise * largest.clamp(self.least_command, 1.0)

    def weights(self, parts: Fields) -> Tensor:
        """Return the probabilities of the models ``(*B, M, A)``."""
        noise = parts["noise"]
        prior = prior_of(self.worth.to(noise), self.odds, noise, self.floor(parts))
        return self.belief(parts).weights(prior)

    def look(self, memory: Tensor, model: DynamicsModel) -> Fields:
        """Return the parts of the memory with the newest pairs and the belief after them."""
        parts = super().look(memory, model)
        newest, size = parts["pairs"][..., -1, :], self.action_size
        _, effect, std, valid, _ = newest.split([size, size, size, 1, self.tail], -1)
        floor = self.floor(parts)
        rules = (self.discount, self.noise_rate, floor, self.tails)
        prior = prior_of(self.worth.to(floor), self.odds, parts["noise"], floor)
        belief = self.belief(parts).update(effect, std, valid, prior, *rules)
        belief = belief._replace(losses=self.surprised(parts["losses"], belief.losses))
        awake = belief.losses[..., 0, :].amax(-1, keepdim=True) > self.odds
        before = parts["late"].squeeze(-1).long()
        late, losses = somewhere(
            awake.squeeze(-1) | (before > 0),
            lambda: self.delayed(belief, belief.weights(prior), before),
            [before, belief.losses],
        )
        parts["late"], belief = late.unsqueeze(-1).to(newest), belief._replace(losses=losses)
        begins = (parts["misaligned"] != 1.0) & awake
        parts["pairs"] = self.aged(parts["pairs"], begins)
        return parts | belief._asdict() | {"misaligned": awake.to(newest)}

    def surprised(self, before: Tensor, losses: Tensor) -> Tensor:
        """Return the losses ``(*B, M, A)`` as models may have them until a change is known.

        What surprises *nothing has changed* surprises all models that have yet to learn of it. One
        that foresaw it better, as some delay may by chance, leads by no more than the odds. And
        while nothing has changed, no model falls farther behind than a change may need: it may
        come at any step (fixed share: Herbster and Warmuth 1998, Machine Learning 32).
        """
        nothing = losses[..., :1, :]
        first = (before[..., :1, :] <= self.odds) & (nothing > self.odds)
        losses = torch.where(first, torch.maximum(losses, nothing - self.odds), losses)
        healthy = (nothing <= losses.amin(-2, keepdim=True) + self.odds).all(-1, keepdim=True)
        return torch.where(healthy, torch.minimum(losses, nothing + self.most_odds), losses)

    def delays_now(self, late: Tensor) -> Tensor:
        """Return the delays of all models ``(*B, M)`` while ``late`` ``(*B)`` is believed."""
        return torch.where(self.delays < 0, late.unsqueeze(-1), self.delays)

    def delayed(self, belief: Belief, weights: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        """Return the delay ``(*B)`` that is believed now, and the losses ``(*B, M, A)``.

        Models that follow a new one begin as good as the best that had it already.
        """
        late = steps_late(weights, before, self.told, self.first)
        theirs = (self.delays == late.unsqueeze(-1)).unsqueeze(-1)
        best = torch.where(theirs, belief.losses, torch.inf).amin(-2, keepdim=True)
        begin = (self.delays < 0) & (late != before).unsqueeze(-1)
        return late, torch.where(begin.unsqueeze(-1), best, belief.losses)

    def asleep(self, parts: Fields, action: Tensor) -> Fields:
        """Return the parts if ``action`` ``(*B, A)`` is executed, and nothing has changed.

        All models predict effects as they are sent, now or late. They are believed alike, but
        that late ones keep what they predict better, as in a cumulative sum: so they are found as
        soon as there is a surprise. And a delay that is believed keeps what it predicts worse.
        """
        losses, late = parts["losses"], parts["late"].squeeze(-1).long()
        commands = self.commands(parts, action)
        acted = commands[..., : commands.shape[-2] - self.delay, :]
        acts = self.acting.to(acted) @ acted[..., acted.shape[-2] - self.acting.shape[-1] :, :]
        follows = (self.delays < 0).unsqueeze(-1)
        acts = torch.where(follows, ago(acted, late).unsqueeze(-2), acts)
        believed = (self.delays_now(late) == late.unsqueeze(-1)) & (late > 0).unsqueeze(-1)
        best = torch.minimum(losses, losses[..., :1, :])
        alike = {"planned": action, "executed": action}
        alike |= {"acting": self.denormalise(ago(acted, late)), "forecasts": acts}
        alike |= {"losses": torch.where(believed.unsqueeze(-1), losses, best)}
        newest = commands.shape[-2] - parts["under_way"].shape[-2]
        return {**parts, **alike, "under_way": commands[..., newest:, :]}

    def commands(self, parts: Fields, executed: Tensor) -> Tensor:
        """Return all commands up to the present one, ``(*B, M + D + 1, A)``, in u.

        Those that have acted, those that are known to wait, and ``executed`` ``(*B, A)``.
        """
        acted = parts["pairs"][..., : self.action_size]
        ahead = torch.cat([parts["sent"], executed.unsqueeze(-2)], -2)
        return torch.cat([acted, self.normalise(ahead)], -2)

    def watch(self, memory: Tensor, planned: Tensor, model: DynamicsModel) -> tuple[Tensor, ...]:
        """Return the memory with the newest pair, and what it is if the plan is executed.

        Returns:
            Both, is any other model to be asked? ``(*B)``, and the innovation ``(*B)``.
        """
        parts = self.look(memory, model)
        innovation = parts["pairs"][..., -1, -self.tail]
        awake = parts["misaligned"].squeeze(-1) == 1.0
        memory = self.pack(parts)
        idle = memory if all_hold(awake) else self.pack(self.asleep(parts, planned))
        return memory, idle, awake, innovation

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
        weights = self.weights(parts)
        answer = self.answer(parts, weights, planned, box)
        acting = self.denormalise((weights * answer.forecasts.to(memory)).sum(-2))
        parts |= {"planned": planned, "executed": answer.executed.to(memory), "acting": acting}
        parts["forecasts"] = answer.forecasts.to(memory)
        parts["under_way"] = answer.under_way.to(memory)
        return (self.pack(parts), *answer[:-2])

    def correct(
        self, memory: Tensor, planned: Tensor, model: DynamicsModel, box: Tensor
    ) -> tuple[Tensor, Correction]:
        """Return the next memory, and what to execute for a planned action ``(*B, A)``."""
        calm = planned.clamp(*box.unbind(-2))
        with torch.no_grad():
            memory, idle, awake, innovation = self._watch(memory, calm, model)
            found = self.unchanged(calm, innovation, box)
            found = found._replace(noise=self.noise_in(memory))
            names = ["memory", *Answer._fields[:-2]]
            still = [idle, *found[:4], found.misaligned]
            changed = somewhere(awake, self._decide, still, memory, planned, box)
            now = dict(zip(names, changed, strict=True))
            now["misaligned"] = now.pop("corrects")
            return now.pop("memory"), found._replace(**now)

    def under_way(self, memory: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the state, the newest commands' effects, and how many of them are to come."""
        parts = self.unpack(memory, self.states_in(memory))
        steps = parts["late"].squeeze(-1).long() + self.delay
        return parts["state"], self.denormalise(parts["under_way"]), steps

    def noise_in(self, memory: Tensor) -> Tensor:
        """Return the noise that was learnt, ``(*B, A)``, in units of the action."""
        return self.denormalise(memory[..., -self.action_size :])

    def believed(self, memory: Tensor) -> Tensor:
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
            seen = self._foresee(self.pack(self.look(memory, model)), action)
            parts = self.unpack(seen, model.state_size)
            weights = self.weights(parts)
            mean, std = mean_and_std(parts["forecasts"], weights)
            return self.denormalise(mean), self.denormalise(torch.hypot(std, parts["noise"]))

    def executing(
        self, memory: Tensor, planned: Tensor, executed: Tensor, misaligned: Tensor | None = None
    ) -> Tensor:
        """Return the memory with the actions that are planned and executed now, ``(*B, A)``."""
        return self._foresee(super().executing(memory, planned, executed, misaligned), executed)

    def reported(self, memory: Tensor, given: Tensor) -> Tensor:
        """Return the memory with forecasts moved by what was given more than sent."""
        _, planned, sent = self.latest(memory)
        parts = self.unpack(super().reported(memory, given), self.states_in(memory))
        if self.delay:
            sent = self.unpack(memory, self.states_in(memory))["sent"][..., 0, :]
        more = self.normalise(given - sent).unsqueeze(-2)
        return self.pack({**parts, "forecasts": parts["forecasts"] + more})

    @torch.no_grad()
    def _foresee(self, memory: Tensor, executed: Tensor) -> Tensor:
        """Return the memory with forecasts of what is executed, where models are to be asked."""
        parts = self.unpack(memory, self.states_in(memory))
        awake = parts["misaligned"].squeeze(-1) == 1.0
        idle = self.asleep(parts, executed)

        def asked(memory: Tensor, executed: Tensor) -> Sequence[Tensor]:
            return self.foresee(self.unpack(memory, self.states_in(memory)), executed)

        still = [idle["forecasts"], idle["under_way"]]
        forecasts, under_way = somewhere(awake, asked, still, memory, executed)
        return self.pack({**parts, "forecasts": forecasts, "under_way": under_way})

    def _watch(self, memory: Tensor, planned: Tensor, model: DynamicsModel) -> Sequence[Tensor]:
        return self.watch(memory, planned, model)

    def _decide(self, *given: Tensor) -> Sequence[Tensor]:
        return self.decide(*given)

    @abstractmethod
    def answer(self, parts: Fields, weights: Tensor, planned: Tensor, box: Tensor) -> Answer:
        """Return what to execute for plans ``(*B, A)``.

        Given the parts of memories, and the probabilities of the models ``(*B, M, A)``.
        """

    @abstractmethod
    def foresee(self, parts: Fields, executed: Tensor) -> tuple[Tensor, Tensor]:
        """Return forecasts ``(*B, M, A)`` and what is under way if ``executed`` is executed."""
