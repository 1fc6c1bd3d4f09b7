"""A planner that searches, and LQR near the goal."""

import math
import warnings
from functools import partial

import pytest
import scipy.linalg
import torch
from furuta.handover import Handover
from tensordict import TensorDict

from afm_rl.dynamics import KnownDynamics, ParametricDynamics
from afm_rl.errors import ConfigurationError
from afm_rl.planning import ICEM, GoalDistance, PlanningEnv, TrackingCost
from afm_rl.planning.riccati import stationary_value
from afm_rl.spaces.manifold import Manifold

SEARCH = partial(ICEM, horizon=20, candidates=64, elites=8, sigma=1.0)
COST = TrackingCost([1.0, 0.1], [0.01], [], angles=[0], in_keys=[])


def swing(state, torque, mass=1.0):
    """A pendulum of 1 m that its motor can lift by a fifth; 0 is upright."""
    angle, speed = state.unbind(-1)
    for _ in range(4):
        speed = speed + 0.0125 * (9.81 * angle.sin() + torque[..., 0] / mass)
        angle = angle + 0.0125 * speed
    return torch.stack([angle, speed], -1)


def planner_of(model, **settings):
    return Handover(PlanningEnv(model, COST, [-2.0], [2.0]), SEARCH, **settings)


def test_the_value_is_that_of_the_algebraic_riccati_equation():
    torch.manual_seed(0)
    move, push = torch.randn(5, 4, 4).double(), torch.randn(5, 4, 2).double()
    weights = torch.eye(4).double(), 0.1 * torch.eye(2).double()
    values, gains = stationary_value(move, push, *weights)
    for a, b, value, gain in zip(move, push, values, gains, strict=True):
        wanted = scipy.linalg.solve_discrete_are(
            a.numpy(), b.numpy(), *map(torch.Tensor.numpy, weights)
        )
        torch.testing.assert_close(value, torch.from_numpy(wanted), rtol=1e-8, atol=1e-8)
        assert torch.linalg.eigvals(a - b @ gain).abs().max() < 1


def test_it_swings_up_from_anywhere_and_stays():
    torch.manual_seed(1)
    planner = planner_of(KnownDynamics(swing, Manifold(2, angles=[0]), 1), level=2.0, cap=40.0)
    angle, speed = math.pi * (2 * torch.rand(16) - 1), 6 * (2 * torch.rand(16) - 1)
    td = planner.make_tensordict_primer()(TensorDict(batch_size=[16]))
    td["observation"] = torch.stack([angle, speed], -1)
    for _ in range(160):
        td = planner(td)
        after = swing(td["observation"], td["action"])
        td = td["next"].set("observation", after)
    assert after[:, 0].cos().min() > 0.999 and after[:, 1].abs().max() < 0.05
    assert not td["icem", "mean"].any()  # near the goal nobody searches, and the next plan is new


def test_near_the_goal_each_mission_has_the_feedback_of_its_own_physics():
    model = heavy_as(1.0)
    planner = planner_of(model, level=5.0)
    model.expand_(2).set_physics(torch.tensor([[1.0], [3.0]]))
    both = push_of(planner, [2])
    alone = [push_of(planner_of(heavy_as(mass), level=5.0), [1]) for mass in (1.0, 3.0)]
    torch.testing.assert_close(both, torch.cat(alone))
    assert both[1] < 2 * both[0] < 0


def heavy_as(mass):
    return ParametricDynamics(swing_with, Manifold(2, angles=[0]), 1, {"mass": mass})


def push_of(planner, batch):
    td = TensorDict({"observation": torch.tensor([0.02, 0.0]).expand(*batch, 2)}, batch)
    return planner(planner.make_tensordict_primer()(td))["action"]


def test_where_there_is_no_feedback_the_other_planner_searches_all_the_same():
    model = heavy_as(1.0)  # with an endless mass nothing lifts it: the equation has no solution
    planner = planner_of(model, level=5.0)
    model.expand_(2).set_physics(torch.tensor([[math.inf], [1.0]]))
    td = TensorDict({"observation": torch.tensor([0.5, 0.0]).expand(2, 2)}, [2])
    assert not planner.regulator(td["observation"])[1][0].isfinite().all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        action = planner(planner.make_tensordict_primer()(td))["action"]
    assert action.isfinite().all() and planner.far.discarded == 0


def swing_with(state, torque, physics):
    return swing(state, torque, physics[..., 0])


def test_what_is_not_quadratic_is_refused():
    env = PlanningEnv(KnownDynamics(swing, Manifold(2), 1), GoalDistance(), [-1.0], [1.0])
    with pytest.raises(ConfigurationError, match="Handover needs a TrackingCost"):
        Handover(env, SEARCH)
