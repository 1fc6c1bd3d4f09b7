"""The core does what its page says: a second implementation, of one mission, agrees with it."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from effects import EFFECTS
from reference import Reference

import afm_rl.correction
from afm_rl.correction.core import RegressionCore
from afm_rl.correction.records import Measurement, Plan
from afm_rl.correction.table import hypotheses, markdown

PAGE = Path(afm_rl.correction.__file__).with_name("README.md")
TICKS, CHANGE, NOISE = 36, 10, (1e-3, 0.05)
MODEL_NOISE = 0.02


def varied(draws, tick, plan):
    """Return the next of plans that vary at random."""
    return 0.7 * plan + 0.5 * (2 * torch.rand(plan.shape, generator=draws) - 1)


def alternating(draws, tick, plan):
    """Return the next of plans that alternate: chatter."""
    swing = 0.4 + 0.3 * torch.rand(plan.shape, generator=draws)
    return 0.2 + (swing if tick % 2 else -swing)


def small(draws, tick, plan):
    """Return the next of plans of about the size of the noise."""
    return 0.1 * varied(draws, tick, 10 * plan)


class Case:
    """Robots with one action, or several, whose actions have other effects from a tick on."""

    def __init__(self, actions, effects=tuple(EFFECTS), plans=varied, every=3, **settings):
        self.actions, self.effects, self.plans, self.every = actions, effects, plans, every
        self.redundant = settings.pop("redundant", False)
        self.broken = settings.pop("broken", ())
        self.outliers = settings.pop("outliers", ())
        self.change = settings.pop("change", CHANGE)
        self.settings = settings

    def drive(self):
        """Yield what goes into each tick of a closed loop, and what comes out, as batches."""
        core = RegressionCore(self.actions, **self.settings)
        draws, size = torch.Generator().manual_seed(0), self.actions
        rows = len(self.effects) * len(NOISE)
        noise = torch.tensor(NOISE).repeat(len(self.effects)).unsqueeze(-1)
        contexts, known_delay = core.contexts, core.known_delay
        memory = core.begin(torch.zeros(rows, 1))
        hidden = torch.zeros(rows, size, size)
        if self.redundant:  # the model sees the sum of two actions
            hidden[:, :2, :2] = torch.tensor([[0.5, -0.5], [-0.5, 0.5]])
        measured = Measurement(
            *torch.zeros(3, rows, size, 1),
            torch.zeros(rows, 1),
            torch.zeros(rows, 1),
            torch.zeros(rows, contexts, 1),
            torch.zeros(rows, size, size),
        )
        plan, place = torch.zeros(rows, size), torch.zeros(rows, contexts)
        queue, acted = [torch.zeros(rows, size)] * known_delay, []
        for tick in range(TICKS):
            plan = self.plans(draws, tick, plan).clamp(-0.8, 0.8)
            ones = torch.ones(rows, size)
            planned = Plan(
                plan,
                -ones,
                ones,
                -ones,
                0.9 * ones,
                torch.stack(queue, -1) if queue else None,
                place if contexts else None,
            )
            after, step = core.tick(memory, measured, planned)
            yield memory, measured, planned, after, step
            memory, queue = after, [*queue, step.command]
            acted.append(queue.pop(0))
            effect = acted[-1]
            if tick >= self.change:
                every = [EFFECTS[name](acted) for name in self.effects]
                effect = torch.stack(every).repeat_interleave(len(NOISE), 0)
                effect = effect[torch.arange(rows), torch.arange(rows)]
                if contexts:
                    effect = torch.where(place[:, :1] > 0, effect, acted[-1])
            effect = effect + noise * torch.randn(effect.shape, generator=draws)
            effect[:, 0] += tick in self.outliers
            seen = memory.expected[..., None] + (torch.eye(size) - hidden) @ (
                effect - memory.expected
            ).unsqueeze(-1)
            effect = seen.squeeze(-1)
            innovation = (effect - acted[-1]).abs().amax(-1, True) / MODEL_NOISE
            gate = (1 - memory.corrected) * memory.usual.exp()
            explained = innovation > gate
            pair = acted[-1], torch.where(explained, effect, acted[-1])
            std = torch.where(explained, MODEL_NOISE, 0.1).expand(rows, size)
            measured = Measurement(
                *(of.unsqueeze(-1) for of in (*pair, std)),
                torch.full((rows, 1), float(tick not in self.broken)),
                innovation,
                place.unsqueeze(-1),
                torch.where(explained[..., None], hidden, memory.hidden),
            )
            place = (place + 0.3 * effect[:, :1]).clamp(-2, 2)


CASES = {
    "one action": Case(1, every=6),
    "two actions": Case(2, every=9),
    "six actions": Case(6, every=12),
    "chatter": Case(2, ["lag", "half"], alternating, every=1),
    "context coordinates": Case(2, ["half", "reversed"], contexts=2),
    "a known delay": Case(2, ["reversed", "lag", "two steps late"], known_delay=1),
    "redundant actuators": Case(3, ["reversed", "first reversed", "half"], redundant=True),
    "from the start": Case(3, ["reversed", "two steps late"], every=1, change=0),
    "an outlier before": Case(2, ["half", "two steps late"], small, outliers=(3,), every=1),
    "faulty readings": Case(2, ["reversed", "lag"], broken=(4, 14, 15, 20), every=2),
}


@pytest.fixture(autouse=True)
def double():
    """Compute in double precision, constants included."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def of_mission(record, k):
    """Return a mission of a batch in numpy."""
    parts = record._asdict().items()
    return type(record)(**{name: x if x is None else x[k].numpy() for name, x in parts})


@pytest.mark.parametrize("name", CASES)
def test_the_core_does_what_its_page_says(name):
    case = CASES[name]
    core = RegressionCore(case.actions, **case.settings)
    reference = Reference(core.table.probes.numpy(), **case.settings)
    compared = 0
    for tick, (*given, memory, step) in enumerate(case.drive()):
        for k in range(-tick % case.every, len(step.command), case.every):
            found = reference.tick(*(of_mission(part, k) for part in given))
            for ours, record in zip(found, (memory, step), strict=True):
                for field, expected in of_mission(record, k)._asdict().items():
                    np.testing.assert_allclose(
                        getattr(ours, field),
                        expected,
                        rtol=0,
                        atol=1e-9,
                        err_msg=f"{field} at tick {tick}, mission {k}",
                    )
        compared += int(step.corrected.sum())
    assert compared > 10


def test_the_page_has_the_table():
    page = PAGE.read_text(encoding="utf-8")
    (table,) = re.findall(r"<!-- table of hypotheses -->\n(.*?)\n<!-- end -->", page, re.DOTALL)
    every = hypotheses(by_context=True)
    shown = [row for row in every if row.delay <= 1]
    assert table == markdown(shown)
