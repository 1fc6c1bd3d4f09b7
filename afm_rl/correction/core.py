"""Action flow matching as one Bayesian regression over a table of hypotheses: the algorithm."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from afm_rl.compiling.tracing import none_holds, where_needed
from afm_rl.correction import belief, decide
from afm_rl.correction.belief import visible
from afm_rl.correction.records import Measurement, Memory, Plan, Settings, Step
from afm_rl.correction.regression import Evidence, Fits, evidence_of, fit
from afm_rl.correction.table import MAX_DELAY, Hypothesis, Table, hypotheses

LIMITED, LEAST_RATE = 12, 0.05  # newest pairs that show a limited rate, and the least one
STUCK, STILL, WIDEST_BAND = 20, 0.005, 0.2  # newest pairs that show stiction; no motion; its band


class RegressionCore(nn.Module):
    """A tick as one pure function of tensors, the same for any robot.

    Everything is a share of the largest action, relative to the neutral action. Shapes: B
    missions, in any number of dimensions, A actuators, M pairs, H hypotheses, of which K can be
    inverted, C commands that are compared.

    Args:
        action_size: A.
        memory: pairs that are remembered, M.
        max_delay: longest delay that is looked for, steps.
        known_delay: steps from a command to its effect that are known.
        contexts: number of state coordinates on which the fault may depend, G.
        settings: of the belief.
        extra_rows: rows of your own, in addition to the table's.
    """

    def __init__(
        self,
        action_size: int,
        memory: int = 80,
        max_delay: int = MAX_DELAY,
        known_delay: int = 0,
        contexts: int = 0,
        settings: Settings = Settings(),  # noqa: B008 - it cannot be changed
        extra_rows: Sequence[Hypothesis] = (),
    ) -> None:
        super().__init__()
        every = [*hypotheses(max_delay, contexts > 0), *extra_rows]
        self.table = Table(every, action_size, max_delay, memory)
        self.action_size, self.pairs, self.contexts = action_size, memory, contexts
        self.known_delay, self.settings = known_delay, settings
        self.newest = max(1, max_delay + known_delay)

    def begin(self, like: Tensor) -> Memory:
        """Return the memory of missions that begin, with the dtype and device of ``(*B, 1)``."""
        size, count, pairs = self.action_size, len(self.table.names), self.pairs
        shapes: dict[str, tuple[int, ...]] = dict(
            commands=(size, pairs),
            effects=(size, pairs),
            stds=(size, pairs),
            validity=(pairs,),
            contexts=(self.contexts, pairs),
            losses=(size, count),
            forecasts=(size, count),
            noise=(size,),
            expected=(size,),
            surprises=(size,),
            usual=(1,),
            corrected=(1,),
            delay=(1,),
            pending=(size, self.newest),
            plans=(size, 3),
            hidden=(size, size),
        )
        zeros = {name: like.new_zeros(*like.shape[:-1], *shape) for name, shape in shapes.items()}
        return Memory(**zeros | {"noise": zeros["noise"] + self.settings.noise})

    def observe(self, memory: Memory, measured: Measurement) -> Memory:
        """Return the memory with what the newest transition showed: steps 1 and 2 alone.

        And whether the next action would be corrected: what is usual of a healthy robot is learnt
        only while it would not.
        """
        memory = belief.remember(memory, measured)
        memory, _, corrects = belief.believe(self.table, self.settings, memory, measured)
        answers = belief.beliefs(self.table, self.settings, memory) @ self.table.answers
        corrected = corrects[..., None] & decide.is_doubted(answers).any(-1, True)
        return memory._replace(corrected=corrected.to(memory.corrected))

    def tick(self, memory: Memory, measured: Measurement, plan: Plan) -> tuple[Memory, Step]:
        """Return the next memory, and what to execute for a plan."""
        sees_all = measured.hidden is None
        # 1. Measure: the last command and its effect are the newest pair (equation 1).
        memory = belief.remember(memory, measured)
        # 2. Believe: hypotheses lose by how far their forecasts were off (equations 2 to 5).
        memory, changed, corrects = belief.believe(self.table, self.settings, memory, measured)
        memory = belief.settle(self.table, self.settings, memory, changed)
        plans = torch.cat([memory.plans, plan.action[..., None]], -1)  # the last four
        memory = memory._replace(plans=plans)
        # While no fault is believed, the plan is executed, and nothing more is computed.
        correct, execute = partial(self.correct, sees_all), partial(self.pass_through, sees_all)
        memory, step = where_needed(corrects, correct, execute, memory, plan)
        return memory._replace(plans=memory.plans[..., 1:]), step

    def correct(self, sees_all: bool, memory: Memory, plan: Plan) -> tuple[Memory, Step]:
        """Return what a tick returns where a fault is believed: its steps 3 to 6."""
        table, settings = self.table, self.settings
        weights = belief.beliefs(table, settings, memory)
        delay = belief.likeliest_delay(table, settings, memory)
        memory = memory._replace(delay=delay)
        # 3. Fit: the posterior of every row of the table (equations 6 and 7).
        evidence = evidence_of(table, memory, plan, None if sees_all else memory.hidden)
        fits = fit(table, memory, evidence)
        # 4. Propose: the plan, the inverse of each hypothesis, and probes (equation 8).
        answers = weights @ table.answers
        planned = decide.sustainable(table, memory, plan, fits, answers)
        commands = decide.propose(table, plan, fits, planned)
        # 5. Decide: the least expected loss, as far as the evidence reaches (equations 9, 10).
        row = answers[..., None, :]
        forecast = decide.Forecast.of(table, fits, row, commands)
        bounds = decide.achievable(table, fits, plan, row, forecast)
        wanted, bounds = decide.attainable_plan(settings, memory, fits, plan, planned, bounds)
        command, effect = decide.choose(table, fits, row, commands, forecast, wanted, memory.noise)
        if plan.limit_low is not plan.low:
            command, effect = decide.limited(table, fits, row, plan, command, effect)
        replaced = decide.is_corrected(fits, answers, command)
        command = torch.where(replaced, command, _inside(plan))
        # 6. Predict: what every hypothesis expects of this command (equation 11).
        memory = self.predict(memory, evidence, fits, weights, command, plan)
        corrected = replaced.any(-1, True)
        memory = memory._replace(corrected=corrected.to(memory.corrected))
        low, high = (
            torch.where(corrected, of, end)
            for of, end in zip(bounds, (plan.low, plan.high), strict=True)
        )
        effect = torch.where(replaced, effect, command)
        return memory, Step(command, effect, low, high, corrected.squeeze(-1))

    def pass_through(self, sees_all: bool, memory: Memory, plan: Plan) -> tuple[Memory, Step]:
        """Return what a tick returns if the plan is executed: commands are expected to act as sent.

        Delays may act as late as they say.
        """
        command, hidden = _inside(plan), None if sees_all else memory.hidden
        acting = command if plan.queue is None else plan.queue[..., 0]
        effect, known = memory.effects[..., -1], memory.validity[..., -1:] > 0
        last = torch.where(known, effect, memory.commands[..., -1]) - acting
        every = self.every_command(memory, command, plan)
        sent = every[..., self.pairs - self.table.max_delay : self.pairs + 1]
        x = torch.cat([sent, last[..., None]], -1)
        memory = memory._replace(
            expected=acting,
            forecasts=visible(hidden, x) @ self.table.idle,
            corrected=torch.zeros_like(memory.corrected),
            pending=every[..., -self.newest :],
        )
        nowhere = torch.zeros_like(memory.delay[..., 0], dtype=torch.bool)
        return memory, Step(command, command, plan.low, plan.high, nowhere)

    def predict(
        self,
        memory: Memory,
        evidence: Evidence,
        fits: Fits,
        weights: Tensor,
        command: Tensor,
        plan: Plan,
    ) -> Memory:
        """Return the memory with what hypotheses expect if ``command`` ``(B, A)`` is executed."""
        table = self.table
        acting = command if plan.queue is None else plan.queue[..., 0]
        seen = visible(fits.hidden, acting)
        x = fits.now + table.basis(seen[..., None, None]).squeeze(-1) @ table.present
        of_each = [(fits.coefficients * x[..., table.index]).sum(-1)]
        if fits.maps is not None:
            of_maps = fits.maps @ pad(acting, (0, 1), value=1.0)[..., None, :, None]
            of_each.append(of_maps.squeeze(-1))
        limited, stuck = held_effects(evidence, seen)
        forecasts = torch.cat([*of_each, torch.stack([limited, stuck, seen], -1)], -1)
        # The effects that are to come, by the hypotheses with the likeliest delay.
        pending = self.every_command(memory, command, plan)[..., -self.newest :]
        late = memory.delay > -self.known_delay
        if not none_holds(late):
            has_delay = table.row_delays == memory.delay[..., None]
            shares = has_delay * weights[..., : len(table.rows)].clamp_min(1e-9)
            curve = (shares / shares.sum(-1, True))[..., None, :] @ fits.curves
            seen = visible(fits.hidden, pending)[..., None, :]
            effects = (curve @ table.basis(seen)).squeeze(-2)
            pending = torch.where(late[..., None], effects, pending)
        expected = (weights * forecasts).sum(-1)
        return memory._replace(forecasts=forecasts, expected=expected, pending=pending)

    def predict_executed(self, memory: Memory, plan: Plan) -> Memory:
        """Return the memory if the planned action is executed, whatever is believed."""

        def expect(memory: Memory, plan: Plan) -> tuple[Memory]:
            weights = belief.beliefs(self.table, self.settings, memory)
            delay = belief.likeliest_delay(self.table, self.settings, memory)
            memory = memory._replace(delay=delay)
            evidence = evidence_of(self.table, memory, plan, memory.hidden)
            fits = fit(self.table, memory, evidence)
            return (self.predict(memory, evidence, fits, weights, plan.action, plan),)

        def idle(memory: Memory, plan: Plan) -> tuple[Memory]:
            return self.pass_through(False, memory, plan)[:1]

        changed = belief.is_changed(self.settings, memory.losses)
        memory = belief.settle(self.table, self.settings, memory, changed)
        return where_needed(changed.squeeze(-1), expect, idle, memory, plan)[0]

    def every_command(self, memory: Memory, command: Tensor, plan: Plan) -> Tensor:
        """Return the commands of all pairs, those under way, and this one, ``(B, A, M + D + 1)``.

        The newest ones have perhaps not acted yet.
        """
        queue = [] if plan.queue is None else [plan.queue]
        return torch.cat([memory.commands, *queue, command[..., None]], -1)


def held_effects(evidence: Evidence, acting: Tensor) -> tuple[Tensor, Tensor]:
    """Return the effects ``(B, A)`` of actuators with a limited rate, and of ones that stick.

    The first moves as fast as the fastest of the last pairs, at most. The second stays where it
    is, if it is asked for less than what it did not follow before.
    """
    v, since = evidence.effects[..., -STUCK:], evidence.since[..., -STUCK:]
    both, moved, now = since[..., 1:] & since[..., :-1], v.diff(dim=-1).abs(), v[..., -1]
    rate, wanted = (both * moved)[..., 1 - LIMITED :].amax(-1).clamp_min(LEAST_RATE), acting - now
    limited = torch.where(both[..., -1], now + wanted.clamp(-rate, rate), acting)
    rests = both & (moved < STILL)
    asked = (evidence.commands[..., 1 - STUCK :] - v[..., 1:]).abs()
    band = (rests * asked).amax(-1).clamp_max(WIDEST_BAND)
    return limited, torch.where(wanted.abs() <= 1.05 * band, now, acting)


def _inside(plan: Plan) -> Tensor:
    """Return the planned action within its bounds, ``(B, A)``."""
    inside = plan.action.clamp(plan.low, plan.high)
    return inside if plan.limit_low is plan.low else inside.clamp(plan.limit_low, plan.limit_high)
