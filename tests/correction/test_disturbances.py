"""What looks like a fault of the actuators, and is none; where no model describes the robot."""

import math

import pytest
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
        state = world(state, correction.executed_action, step)
        memory = corrector.observe(memory, state)
        rows.append((state, planned, correction.executed_action))
    return [torch.stack(part) for part in zip(*rows, strict=True)]


class Alone(ActionFlow):
    """Executes the plan."""

    def correct(self, memory, planned, model, box):
        correction = self.unchanged(planned, torch.zeros(len(planned)), box)
        return self.executing(memory, planned, planned), correction


def both(model, plan, world, start, steps, limit=1.0):
    """Return the states ``(T, B, S)`` with a correction, and without one."""
    high = torch.full((model.action_size,), limit)
    kinds = ActionFlow(-high, high), Alone(-high, high)
    return [episode(kind, model, plan, world, start, steps)[0] for kind in kinds]


def pendulum(state, torque, push=0.0):
    """Return the next angle and speed of an upright pendulum, whose speed may be pushed."""
    angle, speed = state.split(1, -1)
    speed = speed + 0.05 * (15 * angle.sin() + 3 * torque + 3 * push)
    return torch.cat([angle + 0.05 * speed, speed], -1)


@pytest.mark.parametrize(("noise", "gain", "share"), [(0.1, 1.0, 1.05), (0.01, -1.0, 0.2)])
def test_noisy_readings_are_no_fault_and_hide_no_reversal(noise, gain, share):
    model, one = KnownDynamics(lambda x, u: x + 0.2 * u, Manifold(1), 1), torch.ones(1)

    def cost(kind):
        """Return the mean squared state under a policy that answers noisy readings."""
        generator, places = torch.Generator().manual_seed(0), [torch.zeros(24, 1)]

        def plan(seen, step):
            return (-3 * seen).clamp(-1, 1)

        def world(seen, action, step):
            places.append(model(places[-1], (gain if step > 20 else 1.0) * action))
            return places[-1] + noise * torch.randn(24, 1, generator=generator)

        episode(kind(-one, one), model, plan, world, places[0], 80)
        return torch.stack(places).square().mean()

    assert cost(ActionFlow) < share * cost(Alone)


def test_an_oscillating_force_is_no_delay():
    """Commands that are one sine cannot tell them apart; alone the pendulum stands it well."""
    force = torch.tensor([0.6, 0.8, 0.6, 0.4]).unsqueeze(-1)
    frequency = torch.tensor([0.1, 0.07, 0.2, 0.4]).unsqueeze(-1)

    def balance(state, step):
        return (-12 * state[:, :1] - 3 * state[:, 1:]).clamp(-2, 2)

    def world(state, torque, step):
        return pendulum(state, torque, force * (frequency * step).sin())

    model, start = KnownDynamics(pendulum, Manifold(2), 1), torch.tensor([[0.1, 0.0]]).expand(4, 2)
    states = both(model, balance, world, start, 200, limit=2.0)
    corrected, alone = (each[60:].square().mean((0, 2)) for each in states)
    assert (corrected < alone).all()


@pytest.mark.parametrize(("slope", "most"), [(0.0, 1.1), (0.3, 1.2)])
def test_plans_that_alternate_are_followed_by_actuators_that_lag_as_well_as_alone(slope, most):
    """What answers them leaves the box on both sides; on a slope they hardly change their sign."""
    chatter, lag = torch.tensor([[0.3, 1.0], [0.3, 2.0], [0.5, 2.0]]).split(1, -1)
    force = torch.zeros(3, 1)

    def cart(state, force):
        speed = state[..., 1:] + 0.1 * (force - slope)
        return torch.cat([state[..., :1] + 0.1 * speed, speed], -1)

    def plan(state, step):
        away = state[:, :1] - 0.3 * math.sin(0.04 * step)
        hold = slope + chatter * (-1) ** step
        return (hold - 1.5 * away - 1.8 * state[:, 1:]).clamp(-1, 1)

    def world(state, command, step):
        nonlocal force
        force = force + (command - force) / (1 + lag) if step >= 40 else command
        return cart(state, force)

    wanted = 0.3 * (0.04 * torch.arange(240.0)).sin()[:, None]
    states = both(KnownDynamics(cart, Manifold(2), 1), plan, world, torch.zeros(3, 2), 240)
    corrected, alone = ((each[..., 0] - wanted)[40:].abs().mean(0) for each in states)
    assert (corrected < most * alone).all()


@pytest.mark.parametrize("joints", [1, 6])
def test_servos_that_stick_err_at_most_twice_as_far_as_alone(joints):
    band = torch.tensor([0.03, 0.06]).repeat_interleave(3).unsqueeze(-1)

    def world(position, command, step):
        away = command - position
        return position + 0.5 * torch.where(away.abs() < band, 0.0, away)

    phase = 0.7 * torch.arange(6.0).unsqueeze(-1) + 1.3 * torch.arange(joints)
    speed = 0.03 * (1 + 0.3 * torch.arange(joints))

    def reference(step):
        time = speed * step + phase
        return 0.5 * time.sin() + 0.15 * (2.7 * time).sin()

    model = KnownDynamics(lambda q, u: q + 0.5 * (u - q), Manifold(joints), joints)
    wanted = torch.stack([reference(step) for step in range(200)])
    states = both(model, lambda q, k: reference(k + 1), world, reference(0), 200)
    corrected, alone = ((each - wanted).abs().amax((0, 2)).view(2, 3).amax(-1) for each in states)
    assert (corrected <= 2 * alone).all()


@pytest.mark.parametrize("joints", [6, 29])
@torch.no_grad()
def test_swapped_servos_are_corrected_after_a_long_time_with_an_inexact_model(joints):
    """They hold a pose, and move a little; their errors are larger than what the model states."""
    generator, count, change = torch.Generator().manual_seed(0), 2, 40
    draw = torch.rand(4, count, joints, generator=generator)
    pose, size, first, second = 0.6 * draw[0] - 0.3, 0.15 * (0.5 + draw[1]), *(6.28 * draw[2:])
    swapped = torch.arange(joints)
    swapped[:2] = torch.tensor([1, 0])
    effects, plans = [], []

    def gait(state, step):
        jitter = 0.02 * torch.randn(count, joints, generator=generator)
        wave = (0.35 * step + first).sin() + 0.4 * (0.7 * step + second).sin()
        plans.append(pose + size * wave + jitter)
        return plans[-1]

    def world(state, command, step):
        effects.append(command[:, swapped] if step >= change else command)
        noise = 0.02 * torch.randn(count, joints, generator=generator)
        return state + 0.4 * (effects[-1] + noise - state)

    model = KnownDynamics(lambda q, u: q + 0.4 * (u - q), Manifold(joints), joints)
    one = torch.ones(joints)
    episode(ActionFlow(-one, one), model, gait, world, pose, change + 60)
    miss = (torch.stack(effects) - torch.stack(plans)).abs()
    assert (miss[:change] == 0).float().mean() > 0.99
    assert (
        miss[change + 40 :, :, :2].mean() < 0.2 * (plans[-1][:, 0] - plans[-1][:, 1]).abs().mean()
    )


def test_plans_that_turn_seldom_are_followed_wherever_the_box_allows():
    """Nothing is added to them: what a lag of two steps could not give stays undone."""
    plans, force = 0.6 * (1.2 * torch.arange(200.0)).sin(), torch.zeros(1, 1)
    one = torch.ones(1)

    def world(state, command, step):
        nonlocal force
        force = force + (command - force) / (3 if step >= 40 else 1)
        return state + 0.1 * force

    model = KnownDynamics(lambda state, action: state + 0.1 * action, Manifold(1), 1)
    start, plan = torch.zeros(1, 1), lambda state, step: plans[step].view(1, 1)
    states = episode(ActionFlow(-one, one), model, plan, world, start, 200)[0][:, 0, 0]
    forces = states.diff()[100:] / 0.1
    planned = plans[-len(forces) :]
    ahead = planned[1:] - forces[:-1]
    reached = (forces[:-1] + 3 * ahead).abs() < 1
    assert reached.float().mean() > 0.25
    assert (forces - planned)[1:][reached].abs().max() < 0.05
