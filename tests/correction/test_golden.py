"""The correctors answer as they did when their answers were stored.

    python tests/correction/test_golden.py   # stores them again; the commit says why they changed

Eleven effects of actuators and two amounts of noise are the rows of a batch; one robot has one
action, one two, one six; a ground robot has context coordinates, and a known delay.
"""

from pathlib import Path

import pytest
import torch
from effects import EFFECTS, flow_of
from safetensors.torch import load_file, save_file

from afm_rl.correction import ActionFlow, L1Augmentation, LeastSquares
from afm_rl.dynamics import Dubins, KnownDynamics
from afm_rl.spaces.manifold import Manifold

FILE = Path(__file__).with_name("golden.safetensors")
TICKS, CHANGE, NOISE = 36, 10, (1e-3, 0.05)


def point(size):
    """Return the model of a point that moves by its action."""
    return KnownDynamics(lambda state, action: state + action, Manifold(size), size)


def least_squares(form):
    return LeastSquares(-torch.ones(2), torch.ones(2), form=form)


def ground(**settings):
    high = torch.tensor([1.0, 1.5])
    return ActionFlow(-high, high, context_coordinates=[0, 1], **settings)


NAMES = {"executed": "executed_action", "predicted": "predicted_effect", "noise": "noise"}
CASES = {
    "one action": lambda: (flow_of(1), point(1)),
    "two actions": lambda: (flow_of(2), point(2)),
    "six actions": lambda: (flow_of(6), point(6)),
    "ground": lambda: (ground(), Dubins()),
    "ground, a known delay": lambda: (ground(delay=1), Dubins()),
    **{
        f"least squares, {form}": lambda form=form: (least_squares(form), point(2))
        for form in ("gain", "gain_offset", "affine")
    },
    "L1": lambda: (L1Augmentation(-torch.ones(2), torch.ones(2), dt=0.1), point(2)),
}


def drive(corrector, model, count, change, dtype=torch.float32):
    """Drive every row; return the answers at all ticks."""
    draws = torch.Generator().manual_seed(0)
    size, rows = corrector.lowest.shape[-1], len(EFFECTS) * len(NOISE)
    noise = torch.tensor(NOISE, dtype=dtype).repeat(len(EFFECTS)).unsqueeze(-1)
    box = torch.stack(
        [corrector.denormalise(part) for part in (corrector.lowest, corrector.highest)]
    ).expand(rows, 2, -1)
    state, plan = (torch.zeros(rows, n, dtype=dtype) for n in (model.state_size, size))
    memory, sent, found, rows_of = corrector.begin(state), [], [], torch.arange(rows)
    for tick in range(count):
        drawn = torch.rand(rows, size, generator=draws, dtype=dtype)
        plan = 0.7 * plan + 0.5 * (2 * drawn - 1)
        memory, answer = corrector.correct(memory, plan.clamp(-0.8, 0.8), model, box)
        found.append(answer)
        sent.append(corrector.sending(memory, answer.executed_action))
        parts = [effect(sent) for effect in EFFECTS.values()]
        effects = torch.stack(parts)[rows_of // len(NOISE), rows_of] if tick >= change else sent[-1]
        state = model(state, effects)
        state = state + noise * torch.randn(state.shape, generator=draws, dtype=dtype)
        memory = corrector.observe(memory, state)
    return found


def answers(name):
    """Return the answers at all ticks, each ``(T, B, A)``."""
    corrector, model = (part.double() for part in CASES[name]())
    found = drive(corrector, model, TICKS, CHANGE, torch.float64)
    return {
        part: torch.stack([getattr(answer, name) for answer in found])
        for part, name in NAMES.items()
    }


@pytest.mark.parametrize("name", CASES)
def test_answers_are_those_that_were_stored(name):
    stored = load_file(FILE)
    for part, values in answers(name).items():
        # to the precision of what is stored: other processors round otherwise
        torch.testing.assert_close(values.float(), stored[f"{name}: {part}"], rtol=1e-4, atol=1e-4)


if __name__ == "__main__":
    found = {f"{name}: {part}": x.float() for name in CASES for part, x in answers(name).items()}
    save_file({name: x.contiguous() for name, x in found.items()}, FILE)
