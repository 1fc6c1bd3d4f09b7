"""The belief in noise."""

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


def test_in_noise_the_belief_looks_back_longer():
    losses, rules = torch.full((2, 2, 2), 5.0), (0.9, 0.1, 0.02, 1.0)
    noise = torch.tensor([[0.02, 0.2], [0.02, 0.2]])
    belief = Belief(losses, torch.zeros(2, 2, 2), noise)
    prior = prior_of(torch.zeros(1), 2.0, noise, 0.02)
    after = belief.update(torch.zeros(2, 2), noise, torch.ones(2, 1), prior, *rules)
    torch.testing.assert_close(after.losses[0, 0], torch.tensor([4.5, 4.995]))
    assert haste(torch.tensor(0.01), 0.02) == 1.0
