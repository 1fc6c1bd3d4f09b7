"""The correctors answer as they did when their answers were stored.

    python tests/correction/test_golden.py   # stores them anew; the commit says why they changed

Eleven effects of actuators and two amounts of noise are the rows of a batch; one robot has one
action, one two, one six. What a place or a delay changes is asked of a ground robot. Tables in
``golden`` show one tick of some rows, from its fits to what is remembered.
"""

import re
from functools import cache
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from afm_rl.correction import ActionFlow, L1Augmentation, LeastSquares
from afm_rl.correction.achievable import attainable
from afm_rl.correction.experts import MISSES
from afm_rl.dynamics import Dubins, KnownDynamics
from afm_rl.spaces.manifold import Manifold

FILE = Path(__file__).with_name("golden.safetensors")
TABLES = FILE.with_name("golden")
TICKS, CHANGE, NOISE = 36, 10, (1e-3, 0.05)
SHOWN = CHANGE + 3  # the tick of the tables


def before(sent, ticks):
    return sent[-1 - ticks] if len(sent) > ticks else torch.zeros_like(sent[-1])


def first_alone(sent):
    return torch.cat([-sent[-1][:, :1], sent[-1][:, 1:]], -1)


EFFECTS = {
    "healthy": lambda sent: sent[-1],
    "reversed": lambda sent: -sent[-1],
    "half": lambda sent: 0.5 * sent[-1],
    "offset": lambda sent: sent[-1] + 0.2,
    "two steps late": lambda sent: before(sent, 2),
    "reversed and late": lambda sent: -before(sent, 2),
    "slow": lambda sent: sum(0.6 * 0.4**k * before(sent, k) for k in range(5)),
    "first reversed": first_alone,
    "swapped": lambda sent: sent[-1].flip(-1),
    "dead": lambda sent: 0 * sent[-1],
    "dead zone": lambda sent: torch.where(sent[-1].abs() < 0.2, 0 * sent[-1], -sent[-1]),
}


def point(size):
    """Return the model of a point that goes where it is told."""
    return KnownDynamics(lambda state, action: state + action, Manifold(size), size)


def flow(size, **settings):
    return ActionFlow(-torch.ones(size), torch.ones(size), **settings)


def least_squares(form):
    return LeastSquares(-torch.ones(2), torch.ones(2), form=form)


def ground(**settings):
    high = torch.tensor([1.0, 1.5])
    flow = ActionFlow(-high, high, place=[0, 1], **settings)
    flow.place_scale = 0.5
    return flow


CASES = {
    "one action": lambda: (flow(1), point(1)),
    "two actions": lambda: (flow(2), point(2)),
    "six actions": lambda: (flow(6), point(6)),
    "ground": lambda: (ground(), Dubins()),
    "ground, a known delay": lambda: (ground(delay=1), Dubins()),
    **{
        f"least squares, {form}": lambda form=form: (least_squares(form), point(2))
        for form in ("gain", "gain_offset", "affine")
    },
    "L1": lambda: (L1Augmentation(-torch.ones(2), torch.ones(2), dt=0.1), point(2)),
}


# Of which a tick is shown, and of which robot.
SITUATIONS = {
    "healthy": "one action",
    "reversed": "one action",
    "slow": "one action",
    "offset": "two actions",
    "swapped": "two actions",
    "dead": "two actions",
    "two steps late": "six actions",
    "first reversed": "six actions",
}


def drive(corrector, model, count, change, dtype=torch.float32):
    """Drive every row; return memory, plan, box, memory and answer of all ticks."""
    draws = torch.Generator().manual_seed(0)
    size, rows = corrector.lowest.shape[-1], len(EFFECTS) * len(NOISE)
    noise = torch.tensor(NOISE, dtype=dtype).repeat(len(EFFECTS)).unsqueeze(-1)
    box = torch.stack(
        [corrector.denormalise(part) for part in (corrector.lowest, corrector.highest)]
    ).expand(rows, 2, -1)
    state, plan = (torch.zeros(rows, n, dtype=dtype) for n in (model.state_size, size))
    memory, sent, ticks, rows_of = corrector.begin(state), [], [], torch.arange(rows)
    for tick in range(count):
        drawn = torch.rand(rows, size, generator=draws, dtype=dtype)
        plan = 0.7 * plan + 0.5 * (2 * drawn - 1)
        before, planned = memory, plan.clamp(-0.8, 0.8)
        memory, answer = corrector.correct(before, planned, model, box)
        ticks.append((before, planned, box, memory, answer))
        sent.append(corrector.sending(memory, answer.executed))
        parts = [effect(sent) for effect in EFFECTS.values()]
        effects = torch.stack(parts)[rows_of // len(NOISE), rows_of] if tick >= change else sent[-1]
        state = model(state, effects)
        state = state + noise * torch.randn(state.shape, generator=draws, dtype=dtype)
        memory = corrector.observe(memory, state)
    return ticks


@cache
def driven(name):
    """Return corrector, model and ticks of a case."""
    corrector, model = (part.double() for part in CASES[name]())
    return corrector, model, drive(corrector, model, TICKS, CHANGE, torch.float64)


def answers(name):
    """Return the answers at all ticks, each ``(T, B, A)``."""
    *_, found = zip(*driven(name)[-1], strict=True)
    return {
        part: torch.stack([getattr(answer, part) for answer in found])
        for part in ("executed", "predicted", "noise")
    }


@pytest.mark.parametrize("name", CASES)
def test_answers_are_those_that_were_stored(name):
    stored = load_file(FILE)
    for part, values in answers(name).items():
        # to the precision of what is stored: other processors round otherwise
        torch.testing.assert_close(values.float(), stored[f"{name}: {part}"], rtol=1e-4, atol=1e-4)


def table(title, names, **columns):
    """Return names and numbers ``(N, A)`` as text, the axes beside each other."""
    head = "".join(f"{column:>{11 * x.shape[-1]}}" for column, x in columns.items())
    rows = zip(names, torch.cat(list(columns.values()), -1).tolist(), strict=True)
    lines = [name.ljust(20) + "".join(f" {x:10.6f}" for x in numbers) for name, numbers in rows]
    return "\n".join([title.ljust(20) + head, *lines, ""])


def tick_of(effect):
    """Return in tables what a tick does three steps after a change."""
    flow, model, ticks = driven(SITUATIONS[effect])
    row = [len(NOISE) * list(EFFECTS).index(effect)]
    before, plan, box, after = (part[row] for part in ticks[SHOWN][:4])
    answer = [part[row] for part in ticks[SHOWN][4]]
    fields, then = (flow.unpack(memory, model.state_size) for memory in (before, after))
    seen, _ = flow.believe(fields, flow.measure(fields, model))
    weights, noise, size = flow.weights(seen), seen["noise"], flow.action_size
    fits = flow.fit(seen)
    models = flow.likeliest(fits, weights)
    proposals, _ = flow.propose(models, plan, box)
    expected = flow.expect(models, proposals)
    wanted = attainable(plan, *flow.reach(models, expected.effect).unbind(1), flow.saturation)
    loss, axis, together = flow.rate(models, proposals, expected, wanted, noise)

    of_kind = dict(zip(flow.groups, fits, strict=True))
    lines, maps, late = (of_kind[kind] for kind in ("line", "map", "late_gain"))
    names = {kind: [row.name for row in flow.hypotheses if row.kind == kind] for kind in of_kind}
    columns = {"gain": lines.gain[0], "offset": lines.offset[0]}
    columns["variance"] = lines.variance(plan.unsqueeze(1))[0, :, 0]
    of_maps = {"gain": maps.matrix[0].flatten(0, 1)}
    mixing = [f"{name}, axis {k}" for name in names["map"] for k in range(size)]
    proposed = ["plan", "mean", *(f"flow {k}" for k in range(len(flow.points)))]
    proposed += [*(f"nearest {k}" for k in range(MISSES)), *names["line"], *names["map"], "late"]
    rated = [x[0, : len(proposed)] for x in (proposals, loss, axis, together)]
    executed, predicted, spread, bounds = (x[0] for x in answer[:4])
    actions = torch.stack([plan[0], wanted[0], executed, predicted, spread, *bounds])
    newest = then["pairs"][0, -1, : 3 * size].view(3, size)
    then["misaligned"] = flow.misaligned(then).to(then["delay"])
    one = [then[name].expand(1, size) for name in ("delay", "misaligned", "corrects", "usual")]
    kept = torch.cat([then["noise"], then["acting"], newest, *one, then["under_way"][0]])
    words = "noise, acting, command, effect, std, delay, misaligned, corrects, usual".split(", ")
    words += [f"under way {k}" for k in range(len(then["under_way"][0]))]
    belief = {"weight": weights[0], "loss": seen["losses"][0], "expects": then["forecasts"][0]}
    delayed = {"gain": late.gain[0], "variance": late.covariance[0, ..., 1, 1]}
    rates = dict(zip(("action", "loss", "reached", "together"), rated, strict=True))
    said = ["plan", "wanted", "executed", "predicted", "spread", "lowest effect", "highest effect"]
    return "\n".join(
        [
            table("hypothesis", flow.models, **belief),
            table("line", names["line"], **columns),
            table("map of all axes", mixing, **of_maps),
            table("gain of late ones", names["late_gain"], **delayed),
            table("proposal", proposed, **rates),
            table("command", said, action=actions),
            table("remembered", words, number=kept),
        ]
    )


def file_of(effect):
    return TABLES / f"{effect.replace(' ', '_')}.txt"


def words_and_numbers(row):
    words, *numbers = re.split(r" +(?=-?(?:\d+\.\d|inf))", row)
    return words, [float(number) for number in numbers]


@pytest.mark.parametrize("effect", SITUATIONS)
def test_a_tick_does_what_was_stored(effect):
    stored = file_of(effect).read_text(encoding="utf-8").splitlines()
    for found, expected in zip(tick_of(effect).splitlines(), stored, strict=True):
        words, numbers = words_and_numbers(expected)
        assert words_and_numbers(found) == (words, pytest.approx(numbers, rel=1e-5, abs=2e-6))


if __name__ == "__main__":
    found = {f"{name}: {part}": x.float() for name in CASES for part, x in answers(name).items()}
    save_file({name: x.contiguous() for name, x in found.items()}, FILE)
    for effect in SITUATIONS:
        file_of(effect).write_text(tick_of(effect), encoding="utf-8")
