"""What looks like a fault of the actuators, and is none."""

import torch

from afm_rl.correction import ActionFlow
from afm_rl.dynamics import KnownDynamics
from afm_rl.spaces.manifold import Manifold


@torch.no_grad()
def episode(corrector, model, plan, world, state, steps):
    """Return states ``(T, B, S)``, plans and executed actions ``(T, B, A)``."""
    size = model.action_size
    box = torch.stack([corrector.denormalise(x) for x in (corrector.lowest, corrector.highest)])
    box, memory, rows = box.expand(len(state), 2, size), corrector.begin(state), []
    for step in range(steps):
        planned = plan(state, step)
        memory, correction = corrector.correct(memory, planned, model, box)
        state = world(state, correction.executed, step)
        memory = corrector.observe(memory, state)
        rows.append((state, planned, correction.executed))
    return [torch.stack(part) for part in zip(*rows, strict=True)]


class Alone(ActionFlow):
    """Executes the plan."""

    def correct(self, memory, planned, model, box):
        correction = self.unchanged(planned, torch.zeros(len(planned)), box)
        return self.executing(memory, planned, planned), correction


def pendulum(state, torque, push=0.0):
    """Return the next angle and speed of an upright pendulum, whose speed may be pushed."""
    angle, speed = state.split(1, -1)
    speed = speed + 0.05 * (15 * angle.sin() + 3 * torque + 3 * push)
    return torch.cat([angle + 0.05 * speed, speed], -1)


def test_an_oscillating_force_is_no_delay():
    """Commands that are one sine cannot tell them apart; alone the pendulum stands it well."""
    force = torch.tensor([0.6, 0.8, 0.6, 0.4]).unsqueeze(-1)
    frequency = torch.tensor([0.1, 0.07, 0.2, 0.4]).unsqueeze(-1)

    def balance(state, step):
        return (-12 * state[:, :1] - 3 * state[:, 1:]).clamp(-2, 2)

    def world(state, torque, step):
        return pendulum(state, torque, force * (frequency * step).sin())

    model, start = KnownDynamics(pendulum, Manifold(2), 1), torch.tensor([[0.1, 0.0]]).expand(4, 2)
    limit = torch.tensor([2.0])
    costs = [
        episode(kind(-limit, limit), model, balance, world, start, 200)[0][60:]
        .square()
        .mean((0, 2))
        for kind in (ActionFlow, Alone)
    ]
    assert (costs[0] < costs[1]).all()
