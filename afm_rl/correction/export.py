"""The correction as ONNX graphs for one robot: a tick, and the search for the effective action.

Inputs and outputs are the fields of the records, by their names, such as ``memory.commands`` and
``plan.action``. What a graph returns as ``next_memory.commands`` is ``memory.commands`` of the next
call. Fields without numbers, such as contexts where there are none, are left out. Everything is a
share of the largest action, relative to the neutral action.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.compiling.onnx_graph import as_onnx
from afm_rl.correction.action_flow import observed, seen_in_part
from afm_rl.correction.belief import gate
from afm_rl.correction.core import RegressionCore
from afm_rl.correction.records import Measurement, Memory, Plan, Step
from afm_rl.dynamics.inverse import ASSUMED, ROUNDS, UNSEEN, Search, size_of

ABOUT_TICK = {
    "memory": "what is remembered: zeros at first, but .05 in memory.noise; then next_memory of "
    "the tick before",
    "measurement": "the newest pair of command and effect, and what the model shows of it; zeros "
    "at first",
    "measurement.commands": "the command that acted",
    "measurement.effects": "its effective action: the command that explains the transition",
    "measurement.stds": "standard deviations of the effective action",
    "measurement.validity": "1 if the transition counts, else 0",
    "measurement.innovation": "largest error of the model's forecast, in standard deviations",
    "measurement.contexts": "coordinates on which a fault may depend",
    "measurement.hidden": "I - P, with the projection P onto what the model sees of commands; "
    "zeros if it sees all",
    "plan.action": "the planned action",
    "plan.low": "the lowest command that the robot takes",
    "plan.high": "the highest command that the robot takes",
    "plan.limit_low": "the lowest command that may be sent now; plan.low if there is no limit",
    "plan.limit_high": "the highest command that may be sent now; plan.high if there is no limit",
    "plan.queue": "commands that are known to act later, the next one first",
    "plan.context": "coordinates on which a fault may depend, now",
    "next_memory": "the memory of the next tick",
    "step.command": "what to send to the robot",
    "step.effect": "the effect that is expected of it",
    "step.effect_low": "the lowest effect that a command can have",
    "step.effect_high": "the highest effect that a command can have",
    "step.corrected": "is it another command than the plan?",
}
ABOUT_SEARCH = {
    "memory": "fields of the tick's memory, before the tick",
    "search": "zeros at first, then next_search of the call before",
    "sent": "the command that acted",
    "error": "the reading less the model's forecast, by coordinate, in standard deviations of the "
    "model: of the command that acted at first, then of the command asked",
    "jacobian": "derivative of the model's forecast by the command asked, in the same units; read "
    "if it was wanted",
    "next_search": "for the next call",
    "asked": "the command for which the model is evaluated",
    "wants": "1: error; 2: jacobian, without the error; 0: nothing, measurement is complete",
    "measurement": "the newest pair, for the tick",
}


def tick_graph(core: RegressionCore) -> bytes:
    """Return a tick as an ONNX graph, in the precision of the core."""
    graph = TickGraph(core)
    return as_onnx(graph, graph.inputs, graph.outputs, ABOUT_TICK)


def search_graph(core: RegressionCore, coordinates: int) -> bytes:
    """Return the search for the effective action of a model as an ONNX graph.

    Errors and derivatives of the model are in double precision, the memory and the measurement in
    that of the core.

    Args:
        core: that is given the measurement.
        coordinates: how many numbers a difference of states has, D.
    """
    graph = SearchGraph(core, coordinates)
    return as_onnx(graph, graph.inputs, graph.outputs, ABOUT_SEARCH)


class TickGraph(nn.Module):
    """A tick of one robot, as a function of the fields of its records.

    Args:
        core: the algorithm.
    """

    def __init__(self, core: RegressionCore) -> None:
        super().__init__()
        self.core = core
        self.records: tuple[Any, ...] = first_records(core)
        named = zip(("memory", "measurement", "plan"), self.records, strict=True)
        self.inputs = {k: x for name, record in named for k, x in fields_of(name, record).items()}
        memory = fields_of("next_memory", self.records[0])
        self.outputs = [*memory, *(f"step.{name}" for name in Step._fields)]

    def forward(self, *fields: Tensor) -> list[Tensor]:
        """Return the fields of the next memory and of the step."""
        given = iter(fields)
        memory, measured, plan = (
            type(record)._make(next(given) if _has_numbers(x) else x for x in record)
            for record in self.records
        )
        with torch.no_grad():
            memory, step = self.core.tick(memory, measured, plan)
        # A graph returns none of its inputs: what is handed on is copied.
        return [x.clone() for x in (*memory, *step) if _has_numbers(x)]


def first_records(core: RegressionCore) -> tuple[Memory, Measurement, Plan]:
    """Return what the first tick of one robot is given: nothing was measured yet.

    >>> memory, measured, plan = first_records(RegressionCore(2))
    >>> memory.commands.shape, measured.validity
    (torch.Size([2, 80]), tensor([0.]))
    """
    memory = core.begin(core.table.mean.new_zeros(1))
    size, none = core.action_size, memory.commands.new_zeros
    pair, high = none(size, 1), memory.commands.new_ones(size)
    contexts = none(core.contexts, 1)
    measured = Measurement(pair, pair, pair, none(1), none(1), contexts, memory.hidden)
    queue = none(size, core.known_delay) if core.known_delay else None
    context = contexts[..., 0] if core.contexts else None
    return memory, measured, Plan(none(size), -high, high, -high, high, queue, context)


def fields_of(name: str, record: Iterable[Any]) -> dict[str, Tensor]:
    """Return the fields of one robot's record that have numbers, by their full names.

    >>> fields_of("plan", Plan(*[torch.ones(2)] * 5))["plan.low"]
    tensor([1., 1.])
    """
    pairs = zip(record._fields, record, strict=True)  # type: ignore[attr-defined]
    return {f"{name}.{field}": x.clone() for field, x in pairs if _has_numbers(x)}


def _has_numbers(field: Tensor | None) -> bool:
    return field is not None and field.numel() > 0


READ = ("expected", "usual", "corrected", "hidden")  # of the memory, by a search
ERROR, JACOBIAN = 1.0, 2.0  # what is wanted of a model; 0: nothing
# What the model's next answer is: errors of the command that acted, of the one foreseen and of a
# trial; derivatives where the search stands, and at the command that acted.
ACTED, FORESEEN, TRIED, DERIVED, DERIVED_WHERE_ACTED = map(float, range(5))


class Stage(NamedTuple):
    """How far a search has come, ``(1,)`` each."""

    answer: Tensor
    """What the model's next answer is, one of the constants above."""
    rounds: Tensor
    """How many steps were tried."""
    innovation: Tensor
    """Largest error of the forecast for the command that acted."""


class SearchGraph(nn.Module):
    """The rounds of :func:`~afm_rl.dynamics.inverse.effective_action`, one question at a time.

    Call it with the answers of a model until nothing is wanted any more.

    Args:
        core: that is given the measurement.
        coordinates: how many numbers a difference of states has, D.
    """

    def __init__(self, core: RegressionCore, coordinates: int) -> None:
        super().__init__()
        self.settings, size = core.settings, core.action_size
        memory, measured, _ = first_records(core)
        self.memory = memory
        none = partial(torch.zeros, dtype=torch.float64)
        action, error, one = none(size), none(coordinates), none(1)
        derivative = none(coordinates, size)
        search = action, error, one, derivative, action, action, *[one] * 4
        names = [f"search.{name}" for name in (*Stage._fields, *Search._fields)]
        self.inputs = {f"memory.{name}": getattr(memory, name) for name in READ}
        self.inputs |= dict(zip(names, [*[one] * 3, *search], strict=True))
        self.inputs |= {"sent": action, "error": error, "jacobian": derivative}
        self.inputs = {name: value.clone() for name, value in self.inputs.items()}
        pair = [name for name in fields_of("measurement", measured) if "contexts" not in name]
        self.outputs = [*(f"next_{name}" for name in names), "asked", "wants", *pair]

    def forward(self, *fields: Tensor) -> list[Tensor]:
        """Return the next search, the command that is asked about, what is wanted, and the pair.

        Args:
            fields: of the memory, of the search, and ``sent`` ``(A,)``, ``error`` ``(D,)`` and
                ``jacobian`` ``(D, A)``.
        """
        given = iter(fields)
        read = {name: next(given) for name in READ}
        stage = Stage._make(islice(given, len(Stage._fields)))
        search = Search._make(islice(given, len(Search._fields)))
        with torch.no_grad():
            search = search._replace(going=search.going > 0)
            return self._round(self.memory._replace(**read), stage, search, *given)

    def _round(
        self,
        memory: Memory,
        stage: Stage,
        search: Search,
        sent: Tensor,
        error: Tensor,
        jacobian: Tensor,
    ) -> list[Tensor]:
        answer, rounds, innovation = stage
        begins, tried, ends = answer == ACTED, answer == TRIED, answer == DERIVED_WHERE_ACTED
        foreseen, quiet = memory.expected.to(error), gate(self.settings, memory).to(error)
        innovation = torch.where(begins, error.abs().amax(-1, True), innovation)
        silent, finite = innovation <= quiet, innovation < torch.inf
        # The search begins at the command or at the effect foreseen, whichever explains more.
        none = torch.zeros_like(jacobian)
        begun = Search.begin(sent, error, none, torch.zeros_like(answer), ~silent & finite)
        better = (answer == FORESEEN) & (size_of(error) < search.left)
        there = search._replace(effective=foreseen, error=error, left=size_of(error))
        # A derivative is taken over; a trial is judged.
        derived = search.renew(answer == DERIVED, jacobian)
        judged, again = search.judge(search.effective + search.step, error)
        rounds = rounds + tried.to(rounds)
        after = _where(tried, judged, _where(better, there, derived))
        after = _where(begins, begun, after)
        # Next: the effect foreseen, a derivative where the search stands, or a trial.
        more = torch.where(
            tried, after.going & (rounds < ROUNDS), torch.where(begins, after.going, ~ends)
        )
        derives = (answer == FORESEEN) | tried & again
        after = _where(more & ~begins & ~derives, after.propose(), after)
        following = torch.where(begins, FORESEEN, torch.where(derives, DERIVED, TRIED))
        asked = torch.where(derives, after.effective, after.effective + after.step)
        asked = torch.where(begins, foreseen, asked)
        # At the end: how sure it is; and what the model sees, if that may be only a part.
        std = after.doubtful()
        finite = finite & (std.sum(-1, True) < torch.inf)
        found = finite & ~silent
        std = torch.where(found, std, torch.where(silent, ASSUMED, UNSEEN).to(std))
        in_part = seen_in_part(std) | (memory.hidden != 0).any(-1)
        looks = ~more & ~ends & found & in_part.any(-1, True)
        of_seen, hidden = observed(memory.hidden, jacobian, std, found)
        std = torch.where(ends, of_seen, std)
        hidden = torch.where(ends, hidden, memory.hidden)
        following = torch.where(looks, DERIVED_WHERE_ACTED, following).to(answer)
        asked = torch.where(looks, sent, asked)
        wants = torch.where(looks | derives, JACOBIAN, ERROR).to(error) * (more | looks)
        # Without a further question, the next call begins a new search.
        after = after._replace(going=after.going.to(error))
        kept = following, rounds, innovation, *after
        carried = [torch.where(more | looks, value, 0.0) for value in kept]
        effect = torch.where(found, after.effective, sent)
        pairs = [value.unsqueeze(-1) for value in (sent, effect, std)]
        measured = *pairs, finite, torch.where(finite, innovation, 0.0), hidden
        return [*carried, asked, wants, *(value.to(memory.hidden) for value in measured)]


def _where(which: Tensor, there: Search, elsewhere: Search) -> Search:
    """Return one search or the other, by ``which`` ``(1,)``."""
    return Search._make(torch.where(which, *pair) for pair in zip(there, elsewhere, strict=True))
