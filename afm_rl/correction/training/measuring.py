"""The effective action as a graph: what a host's model has to say next, and what it has shown."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from afm_rl.compiling.onnx_graph import as_onnx, trace
from afm_rl.correction import ActionFlow
from afm_rl.correction.base import Layout
from afm_rl.correction.core import Core
from afm_rl.dynamics.inverse import ASSUMED, ROUNDS, UNSEEN, Search, size_of

NAME = "afm_measure"
INPUTS = ("memory", "search", "sent", "error", "jacobian")
OUTPUTS = ("next_search", "asked", "wants", "measured")
MEANINGS = {
    "memory": "of the core, before its tick",
    "search": "zeros at first, then next_search of the call before",
    "sent": "the command that acted",
    "error": "the reading less what the model expects, by coordinate, in standard deviations of "
    "the model: of the command sent at first, then of the one that is asked for",
    "jacobian": "the model's expectation by the command, in the same units, where it is wanted",
    "next_search": "for the next call",
    "asked": "the command that the model is asked about",
    "wants": "1: error; 2: jacobian, there; 0: nothing, measured is complete",
    "measured": "the newest pair, for the core",
}
DONE, FORECAST, DERIVATIVE = 0.0, 1.0, 2.0
# What the last answer was: of the command sent, of the one foreseen, a derivative, of a trial.
SENT, FORESEEN, DERIVED, TRIED = 0.0, 1.0, 2.0, 3.0


class MeasureGraph(nn.Module):
    """The rounds of :func:`~afm_rl.dynamics.inverse.effective_action`, asked one by one.

    Whoever runs a model calls it with its answers until nothing is wanted any more. Everything is
    a share of the largest action.

    Args:
        core: for whose number of actuators, and whose memory.
        coordinates: how many numbers a difference of states has, D.
    """

    def __init__(self, core: Core, coordinates: int) -> None:
        super().__init__()
        self.core, size = core, core.action_size
        actions, shape = (size,), (coordinates, size)
        sizes = [actions, (coordinates,), (1,), shape, actions, actions, *[(1,)] * 4]
        search = dict(zip(Search._fields, sizes, strict=True))
        self.layout = Layout.of({"answer": (1,), "rounds": (1,), "innovation": (1,), **search})

    def forward(
        self, memory: Tensor, search: Tensor, sent: Tensor, error: Tensor, jacobian: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the next search, the command in question, what is wanted, and the pair.

        Args:
            memory: of the core, before its tick, ``(P,)``.
            search: what was returned before; zeros for a new transition, ``(S,)``.
            sent: the command that acted, ``(A,)``.
            error: the reading less the model's forecast, in its standard deviations, ``(D,)``.
            jacobian: of that forecast by the command, ``(D, A)``; read where it is wanted.

        Returns:
            ``(S,)``, ``(A,)``, ``(1,)``, and ``(3 A + 2,)`` as the core takes it.
        """
        fields, before = self.core.learnt.unpack(memory), self.layout.unpack(search)
        answer, rounds, innovation = (before.pop(k) for k in ("answer", "rounds", "innovation"))
        quiet, foreseen = self.core.quiet_in(fields).to(error), fields["acting"].to(error)
        looks = answer == SENT
        innovation = torch.where(looks, error.abs().amax(-1, True), innovation)

        # It begins at what was sent or foreseen, whichever explains the reading better.
        going = (innovation > quiet) & (innovation < torch.inf)
        begun = Search.begin(
            sent, error, torch.zeros_like(jacobian), torch.zeros_like(quiet), going
        )
        known = Search(**{**before, "going": before["going"] > 0})
        better = known._replace(effective=foreseen, error=error, left=size_of(error))
        started = _where(size_of(error) < known.left, better, known)

        # A derivative is an answer, too; a trial is judged.
        derived = known.renew(torch.ones_like(going), jacobian)
        tried, again = known.judge(known.effective + known.step, error)
        rounds = rounds + (answer == TRIED).to(rounds)
        after = _where(answer == DERIVED, derived, _where(answer == TRIED, tried, started))
        after = _where(looks, begun, after)
        more = torch.where(answer == TRIED, after.going & (rounds < ROUNDS), ~looks | going)

        # Next: what was foreseen, a derivative where the search stands, or a step.
        again = (answer == FORESEEN) | (answer == TRIED) & again
        following = torch.where(looks, FORESEEN, torch.where(again, DERIVED, TRIED)).to(error)
        after = _where(more & (following == TRIED), after.propose(), after)
        asked = torch.where(following == TRIED, after.effective + after.step, after.effective)
        asked = torch.where(looks, foreseen, asked)
        wants = torch.where(again, DERIVATIVE, FORECAST).to(error) * more.to(error)

        # What is known when nothing is wanted.
        std, silent = after.doubtful(), innovation <= quiet
        finite = innovation + std.sum(-1, True) < torch.inf
        row = finite & ~silent
        std = torch.where(row, std, torch.where(silent, ASSUMED, UNSEEN).to(std))
        effective = torch.where(row, after.effective, sent)
        pair = [sent, effective, std, finite.to(std), torch.where(finite, innovation, 0.0)]
        measured = torch.cat(pair, -1).to(memory)
        state = {"answer": following, "rounds": rounds, "innovation": innovation}
        after = after._replace(going=after.going.to(error))
        found = self.layout.pack({**state, **after._asdict()})
        return torch.where(more, found, 0.0), asked, wants, measured

    def example(self) -> list[Tensor]:
        """Return inputs of a first call."""
        size, count = self.core.action_size, self.layout.shapes[self.layout.names.index("error")]
        memory, search = torch.zeros(sum(self.core.learnt.sizes)), sum(self.layout.sizes)
        shapes = [(search,), (size,), count, (*count, size)]
        return [memory, *(torch.zeros(shape, dtype=torch.float64) for shape in shapes)]


def measure_graph(actuators: int, coordinates: int) -> bytes:
    """Return the rounds for so many actuators, and states that differ by so many numbers: ONNX."""
    high = torch.ones(actuators)
    graph = MeasureGraph(ActionFlow(-high, high), coordinates)
    return as_onnx(trace(graph, graph.example()), INPUTS, OUTPUTS, MEANINGS)


def _where(which: Tensor, there: Search, elsewhere: Search) -> Search:
    """Return a search by rows ``(*B, 1)``."""
    pairs = zip(there, elsewhere, strict=True)
    of_rows = (which[(..., *[None] * (one.dim() - which.dim()))] for one in there)
    return Search._make(torch.where(k, *pair) for k, pair in zip(of_rows, pairs, strict=True))
