"""MPPI: its formulas, and its mean plan."""

import pytest
import torch
from harness import situation
from hypothesis import given
from hypothesis import strategies as st

from afm_rl.planning import MPPI
from afm_rl.planning.mppi import path_weights, smooth

LOW, HIGH = torch.tensor([-1.0, -1.5]).double(), torch.tensor([1.0, 2.0]).double()


@pytest.mark.parametrize("within", [True, False])
@pytest.mark.parametrize("beta", [0.1, 0.6, 1.0])
def test_smoothing_is_a_low_pass_from_step_to_step(beta, within):
    plan, past = 2 * torch.randn(3, 4, 6, 2).double(), torch.randn(3, 1, 2).double()
    smoothed = smooth(plan, past, beta, LOW, HIGH, within)
    assert smoothed.shape == plan.shape
    now = past
    for step in range(6):
        now = beta * plan[:, :, step] + (1 - beta) * now
        clamped = now.clamp(LOW, HIGH)
        torch.testing.assert_close(smoothed[:, :, step], clamped)
        now = clamped if within else now


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=20), st.floats(1e-3, 1e3))
def test_weights_are_a_softmax(returns, temperature):
    returns = torch.tensor(returns, dtype=torch.float64)
    weights = path_weights(returns, temperature)
    assert float(weights.sum()) == pytest.approx(1)
    torch.testing.assert_close(weights, (returns / temperature).softmax(-1))


SMALL = {"horizon": 4, "candidates": 32}


def robots(*batch):
    return situation(*batch, name="mppi", mean=(4, 2))


def plan(planner, td):
    return planner(td.clone())["next", "mppi", "mean"]


def test_without_noise_the_plan_is_shifted_and_smoothed(world):
    td = robots(3)
    before = td["mppi", "mean"].clamp(-0.9, 0.9)
    td["mppi", "mean"] = before
    shifted = torch.cat([before[:, 1:], before[:, -1:]], 1)
    assert torch.equal(td["mppi", "mean"], before)
    torch.testing.assert_close(plan(MPPI(world, sigma=0.0, beta=1.0, **SMALL), td), shifted)
    for past, first in (("previous", before[:, 0]), ("shifted", shifted[:, 0])):
        smoothed = plan(MPPI(world, sigma=0.0, beta=0.6, past=past, **SMALL), td)
        torch.testing.assert_close(smoothed[:, 0], 0.6 * shifted[:, 0] + 0.4 * first)


def test_noise_scales_with_the_half_range_or_is_of_unit_size(world, box):
    scaled, unit = MPPI(world, sigma=0.2), MPPI(world, sigma=0.2, noise="unit")
    torch.testing.assert_close(scaled.scale, 0.2 * (box[1] - box[0]) / 2)
    assert torch.equal(unit.scale, torch.ones(2))


def test_a_bounds_key_that_nobody_writes_is_announced(world):
    with pytest.warns(UserWarning, match="bounds_key='bocks': the tensordict has no such entry"):
        plan(MPPI(world, bounds_key="bocks", **SMALL), robots(1))


def test_noise_grows_with_the_box(world, box):
    td = robots(2)
    td["mppi", "mean"] = torch.zeros(2, 4, 2)
    td["box"] = torch.stack([torch.stack(box), 2 * torch.stack(box)])
    seen = []
    planner = MPPI(world, horizon=4, candidates=500, beta=1.0, seed_key="seed", bounds_key="box")
    td["seed"] = torch.tensor([3, 3])
    planner._returns = lambda td, plans: seen.append(plans) or torch.zeros(2, 500)
    planner(td)
    torch.testing.assert_close(seen[0][1], 2 * seen[0][0])
