"""The belief: its formulas, and what it makes of noise."""

import math

import pytest
import torch

from afm_rl.correction import ActionFlow
from afm_rl.correction.belief import Belief, haste, prior_of
from afm_rl.dynamics import KnownDynamics
from afm_rl.spaces.manifold import Manifold

LOW = -torch.ones(1)
MODEL = KnownDynamics(lambda state, action: state + 0.2 * action, Manifold(1), 1)


def cost(corrector, noise, gain=1.0, count=24, steps=80):
    """Return the mean squared state under a policy that answers noisy readings."""
    generator = torch.Generator().manual_seed(0)
    box = torch.stack([LOW, -LOW]).expand(count, 2, 1)
    state, total = torch.zeros(count, 1), torch.zeros(())
    seen = state
    memory = None if corrector is None else corrector.begin(seen)
    for step in range(steps):
        action = (-3 * seen).clamp(-1, 1)
        if corrector is not None:
            memory, found = corrector.correct(memory, action, MODEL, box)
            action = found.executed
        state = MODEL(state, (gain if step > 20 else 1.0) * action)
        seen = state + noise * torch.randn(count, 1, generator=generator)
        if corrector is not None:
            memory = corrector.observe(memory, seen)
        total = total + state.square().mean() / steps
    return float(total)


def test_noisy_readings_are_no_fault_of_the_actuators():
    alone = cost(None, 0.1)
    assert cost(ActionFlow(LOW, -LOW), 0.1) < 1.05 * alone


def test_a_reversal_is_found_in_noise():
    alone = cost(None, 0.01, gain=-1.0)
    assert cost(ActionFlow(LOW, -LOW), 0.01, gain=-1.0) < 0.2 * alone


@pytest.mark.parametrize("valid", [0.0, 1.0])
@pytest.mark.parametrize(
    ("effect", "std", "noise"),
    [
        (0.5, 0.0, 0.1),
        (9.0, 0.1, 0.1),  # a miss from which noise learns in steps
        (0.21, 0.5, 0.3),  # less than the reading's own error
        (0.2, 0.0, 0.02),  # exact: noise stays at its floor
        (-0.4, 0.3, 0.1),  # the third foresaw it, and the first is more probable all the same
    ],
)
def test_the_update_is_that_of_its_formulas(effect, std, noise, valid):
    losses, forecasts, odds = (0.4, 2.0, 0.3), (0.1, 0.2, -0.7), (1.0, 0.0, -1.0)
    discount, rate, floor, tails = 0.9, 0.2, 0.02, 3.0
    look = 1 - (1 - discount) * min(1.0, (floor / noise) ** 2)
    squares, wanted = [(effect - forecast) ** 2 for forecast in forecasts], list(losses)
    if valid:
        wanted = [
            look * loss + 0.5 * (tails + 1) * math.log1p(square / (noise**2 + std**2) / tails)
            for loss, square in zip(losses, squares, strict=True)
        ]
    best = min(range(3), key=lambda k: wanted[k] - odds[k])
    excess = min(max(squares[best] - std**2, 0.0), 3 * noise**2)
    gain = rate * valid * noise**2 / (noise**2 + std**2)
    wanted_noise = max(math.sqrt(noise**2 + gain * (excess - noise**2)), floor)

    def column(*numbers):
        return torch.tensor(numbers, dtype=torch.float64).unsqueeze(-1)

    belief = Belief(column(*losses), column(*forecasts), column(noise)[0])
    given = column(effect)[0], column(std)[0], column(valid)[0], column(*odds)
    after = belief.update(*given, discount, rate, floor, tails)
    torch.testing.assert_close(after.losses, column(*wanted))
    torch.testing.assert_close(after.noise, column(wanted_noise)[0])


def test_a_delay_that_changes_is_the_best_one_at_every_step_on_all_axes():
    forecasts = torch.tensor([[0.0, 0.0], [0.5, 0.5], [0.9, 0.9], [0.0, 0.0]])
    belief = Belief(torch.zeros(4, 2), forecasts, torch.full((2,), 0.02))
    given = torch.tensor([0.5, 0.6]), torch.zeros(2), torch.ones(1), torch.zeros(4, 2)
    delays, any_delay = torch.tensor([0, 1, 2]), torch.arange(4).unsqueeze(-1) == 3
    after = belief.update(*given, 0.95, 0.1, 0.02, 1.0, delays, any_delay).losses
    torch.testing.assert_close(after[3], after[1] + math.log(3) / 2)
    torch.testing.assert_close(after[:3], belief.update(*given, 0.95, 0.1, 0.02, 1.0).losses[:3])


def test_in_noise_no_model_is_worth_more_than_others():
    noise = torch.tensor([0.02, 0.2])
    prior = prior_of(torch.tensor([0.0, -6.0]), 1.5, noise, 0.02).exp()
    torch.testing.assert_close(prior[0], torch.full((2,), math.exp(1.5)))
    torch.testing.assert_close(prior[2] / prior[1], torch.tensor([-6.0, -0.06]).exp())
    torch.testing.assert_close(prior[1:].sum(0), torch.ones(2))


def test_in_noise_the_belief_looks_back_longer():
    losses, rules = torch.full((2, 2, 2), 5.0), (0.9, 0.1, 0.02, 1.0)
    noise = torch.tensor([[0.02, 0.2], [0.02, 0.2]])
    belief = Belief(losses, torch.zeros(2, 2, 2), noise)
    prior = prior_of(torch.zeros(1), 2.0, noise, 0.02)
    after = belief.update(torch.zeros(2, 2), noise, torch.ones(2, 1), prior, *rules)
    torch.testing.assert_close(after.losses[0, 0], torch.tensor([4.5, 4.995]))
    assert haste(torch.tensor(0.01), 0.02) == 1.0
