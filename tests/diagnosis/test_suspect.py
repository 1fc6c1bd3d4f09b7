"""The guard before a fit: healthy steps pass, steps with a fault are named."""

import pytest
import torch

from afm_rl.diagnosis.suspect import suspect
from afm_rl.dynamics import KnownDynamics
from afm_rl.spaces.manifold import Manifold


def arm(state, action, mass=1.0, damping=0.2, load=0.0):
    """Three joints with coupled torques."""
    angle, speed = state.chunk(2, -1)
    torque = action + 0.3 * action.roll(1, -1) - load - angle.sin()
    speed = speed + 0.1 * (torque / mass - damping * speed)
    return torch.cat([angle + 0.1 * speed, speed], -1)


MODEL = KnownDynamics(arm, Manifold(6), 3)


def played(fault, at=0, steps=100, seed=0, **physics):
    """Return noisy steps of a robot whose actuators have a fault from a step on."""
    generator = torch.Generator().manual_seed(seed)
    commands = torch.randn(steps, 3, generator=generator).cumsum(0)
    commands = (0.7 * (commands - 0.9 * commands.roll(1, 0))).clamp(-1, 1)
    state, rows = torch.zeros(6), []
    for k, command in enumerate(commands):
        acted = fault(commands[: k + 1]) if k >= at else command
        rows.append((state, command, arm(state, acted, **physics)))
        state = rows[-1][-1] + 1e-3 * torch.randn(6, generator=generator)
        rows[-1] = (*rows[-1][:2], state)
    return [torch.stack(column) for column in zip(*rows, strict=True)]


def healthy(sent):
    return sent[-1]


FAULTS = {
    "3 steps late": lambda sent: sent[-4] if len(sent) > 3 else 0 * sent[-1],
    "all reversed": lambda sent: -sent[-1],
    "actuator 1 reversed": lambda sent: sent[-1] * torch.tensor([1.0, -1.0, 1.0]),
    "actuator 2 at half": lambda sent: sent[-1] * torch.tensor([1.0, 1.0, 0.5]),
    "actuator 0 dead": lambda sent: sent[-1] * torch.tensor([0.0, 1.0, 1.0]),
    "actuators 0 and 2 swapped": lambda sent: sent[-1][[2, 1, 0]],
    "all with an offset of -20 %": lambda sent: sent[-1] - 0.2,
}


@pytest.mark.parametrize("words", FAULTS)
@pytest.mark.parametrize("at", [0, 50])
def test_steps_with_a_fault_are_named(words, at):
    for seed in range(3):
        steps = played(FAULTS[words], at, seed=seed, mass=1.1, damping=0.3)
        assert suspect(MODEL, *steps) == words


def test_healthy_steps_pass_though_the_model_is_wrong():
    for seed in range(10):
        assert suspect(MODEL, *played(healthy, seed=seed)) == ""
        steps = played(healthy, seed=seed, mass=1.15, damping=0.3, load=0.03)
        assert suspect(MODEL, *steps) == ""


def test_delays_are_not_looked_for_across_episodes():
    steps = played(FAULTS["3 steps late"], steps=200)
    assert suspect(MODEL, *steps) == "3 steps late"
    apart = [part[::3] for part in steps]  # no step follows another
    assert "late" not in suspect(MODEL, *apart)


def test_a_servo_is_reversed_about_its_pose():
    model = KnownDynamics(arm, Manifold(6), 3)
    model.home = torch.tensor([0.3, -0.2, 0.4])
    steps = played(lambda sent: 2 * model.home - sent[-1])
    assert suspect(model, *steps, names=["hip", "knee", "foot"]) == "all reversed"
