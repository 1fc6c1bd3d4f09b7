"""The belief in noise."""

import torch

from afm_rl.correction import ActionFlow
from afm_rl.correction.arrival import steps_late
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


def test_a_motor_reversed_in_a_gait_is_not_late_since_the_others_are_not():
    low, count = -torch.ones(4), 8
    model = KnownDynamics(lambda state, action: state + 0.2 * action, Manifold(4), 4)
    flow, box = ActionFlow(low, -low), torch.stack([low, -low]).expand(count, 2, 4)
    sign, phase = torch.tensor([-1.0, 1.0, 1.0, 1.0]), torch.linspace(0.0, 6.0, count)
    memory = flow.begin(state := torch.zeros(count, 4))
    late = torch.tensor(["late" in cause for cause in flow.causes])
    for step in range(40):
        angle = 0.4 * step + phase.unsqueeze(-1) + torch.arange(4)
        memory, found = flow.correct(memory, 0.8 * angle.sin(), model, box)
        state = model(state, (sign if step >= 30 else 1.0) * found.executed)
        memory = flow.observe(memory, state)
        assert step < 30 or flow.belief_in(memory)[:, late].sum(1)[:, 0].max() < 0.2


def test_no_axis_speaks_against_its_own_delay():
    """One of three axes looks a step late, the others not at all."""
    weights = torch.tensor([[0.02, 0.45, 0.45], [0.02, 0.45, 0.45], [0.9, 0.05, 0.05]])
    weights = torch.cat([weights, 1 - weights.sum(0, keepdim=True)])
    given = torch.zeros(4, 1), torch.tensor([0, 0, 1, 2]), torch.tensor(0), 2
    against = steps_late(weights, *given)[1]
    assert (against <= 0).all()
    assert (against[0] == 0).all()
    assert (against[1:, 0] < -3).all()
    other = weights.clone()
    other[:, 0] = torch.tensor([0.45, 0.45, 0.05, 0.05])
    torch.testing.assert_close(steps_late(other, *given)[1][:, 0], against[:, 0])
