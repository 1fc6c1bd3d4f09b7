"""The belief: its formulas, and what it makes of noise."""

import math

import pytest
import torch

from afm_rl.correction.belief import Belief, prior_of


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
