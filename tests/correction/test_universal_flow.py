"""What the weights of the package can do, on robots that they have never seen.

A point that goes where it is told, in 1 to 17 dimensions, closed loop, from the first step.
"""

import pytest
import torch

from afm_rl.correction import ActionFlow

SIZES = [1, 2, 6, 17]
STEPS = 20


def flow_of(size, **settings):
    return ActionFlow(-torch.ones(size), torch.ones(size), **settings)


def gains(size):
    sign = torch.ones(size)
    sign[1::2] = -1.0
    return sign * torch.linspace(0.6, 1.6, size)


def half_reversed(sent):
    sign = torch.ones(sent[-1].shape[-1])
    sign[::2] = -1.0
    return sign * sent[-1]


REGIMES = {
    "reversed": lambda sent: -sent[-1],
    "half reversed": half_reversed,
    "gains": lambda sent: gains(sent[-1].shape[-1]) * sent[-1],
    "bias": lambda sent: sent[-1] + 0.25,
    "two swapped": lambda sent: torch.cat(
        [sent[-1][..., 1:2], sent[-1][..., :1], sent[-1][..., 2:]], -1
    ),
}


def miss_of(effects, planned, steps):
    """Return the root mean square miss of plans from a step on, by mission and axis."""
    return (effects - planned)[steps:].square().mean(0).sqrt()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", REGIMES)
def test_faults_are_corrected_within_few_steps(line, drive, plans, name, size):
    if name == "two swapped" and size == 1:
        pytest.skip("needs two axes")
    planned = plans(STEPS, 4, size, size=0.5)
    found, effects = drive(flow_of(size), line(size), REGIMES[name], planned)
    after = 16 if name == "two swapped" else 8
    can = (planned.abs() <= 1).all(-1)
    assert can.all()
    idle = (REGIMES[name]([planned[after:]]) - planned[after:]).square().mean().sqrt()
    miss = miss_of(effects, planned, after)
    # Which two of 17 are swapped cannot be told from so few pairs; it must do no harm.
    least = 1.0 if (name, size) == ("two swapped", 17) else 0.35
    assert miss.median() < 0.05 and miss.square().mean().sqrt() < least * idle
    foreseen = (found[1] - effects)[after:].square().mean().sqrt()
    assert foreseen < 0.12


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_late_commands_of_a_reversed_motor_are_found(line, drive, plans, delay):
    planned = plans(4, 8, 2, size=0.5).repeat_interleave(12, 0)  # steady for a while

    def late(sent):
        return -sent[-1 - delay] if len(sent) > delay else torch.zeros_like(sent[-1])

    _, effects = drive(flow_of(2), line(2), late, planned)
    settled = torch.arange(48) % 12 >= 10
    settled[:24] = False
    assert (effects - planned)[settled].abs().median() < 0.08


@pytest.mark.parametrize("size", SIZES)
def test_noise_alone_is_not_worth_a_correction(line, drive, plans, size):
    planned = plans(STEPS, 24, size)
    generator = torch.Generator().manual_seed(0)

    def noisy(sent):
        return sent[-1] + 0.1 * torch.randn(sent[-1].shape, generator=generator)

    _, effects = drive(flow_of(size), line(size), noisy, planned)
    assert miss_of(effects, planned, 8).square().mean().sqrt() < 1.6 * 0.1


def test_a_noisy_reversed_robot_is_corrected(line, drive, plans):
    planned = plans(STEPS, 16, 2, size=0.5)
    flow, model = flow_of(2), line(2, noise_std=0.03)
    _, effects = drive(flow, model, lambda sent: -sent[-1], planned, noise=0.03)
    assert (effects - planned)[8:].abs().median() < 0.08


def test_an_outlier_does_little_harm(line, drive, plans):
    planned = plans(STEPS, 8, 2, size=0.5)

    def wild(sent):
        return -sent[-1] + (1.0 if len(sent) == 12 else 0.0)

    _, effects = drive(flow_of(2), line(2), wild, planned)
    assert (effects - planned)[13:].abs().median() < 0.06


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_bounds_say_what_can_be_had(line, drive, plans, gain):
    found, _ = drive(flow_of(2), line(2), lambda sent: gain * sent[-1], plans(12, 4, 2, size=0.4))
    low, high = found[3][-1].unbind(-2)
    expected = max(gain, 1.0)  # never less than the box
    torch.testing.assert_close(high, torch.full((4, 2), expected), rtol=0.25, atol=0)
    torch.testing.assert_close(low, torch.full((4, 2), -expected), rtol=0.25, atol=0)
