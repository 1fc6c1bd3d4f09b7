"""Quadrotor flights under model predictive control, against published figures."""

import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from afm_rl.dynamics.quadrotor import Quadrotor
from afm_rl.envs import Circle, CrazyflieTrack
from afm_rl.planning import MPC, PlanningEnv, TrackingCost
from afm_rl.spaces.airframe import QuadrotorBody

SPEEDS = (0.8, 1.0, 1.2)
CHANGES = [{}, {"mass": 0.5}, {"mass": 4 / 3}]


def pilot(**settings):
    """Return the planner of the published flights: every weight is 1."""
    level = [0.0] * 9 + [1.0] + [0.0] * 3
    cost = TrackingCost([1.0] * 13, [1.0] * 4, range(6), rest=level)
    return MPC(PlanningEnv(Quadrotor(), cost, *QuadrotorBody().bounds), **settings)


def fly(planner, ticks=160, **settings):
    """Fly circles of 2 m; return the whole flight."""
    env = CrazyflieTrack([Circle(2.0, speed) for speed in SPEEDS], **settings)
    missions = [env.mission(track, seed=0, regime=CHANGES) for track in range(len(SPEEDS))]
    env = TransformedEnv(env, planner.make_tensordict_primer())
    start = env.reset(torch.stack(missions), set_state=False)
    return env.rollout(ticks, planner, tensordict=start, auto_reset=False, trust_policy=True)


def test_a_previewed_reference_is_followed_closely():
    data = fly(pilot(), 40)  # until the mass changes
    assert (data["next", "square_error"].mean((1, 2)) < 2e-3).all()


def test_only_the_thrust_needs_a_bound():
    whole, thrust = (fly(pilot(bounded=bounded), 20, start="rest") for bounded in (None, [0]))
    torch.testing.assert_close(whole["action"], thrust["action"], rtol=0, atol=1e-6)


def test_a_flight_that_starts_upside_down_still_gets_sound_actions():
    planner = pilot()
    td = TensorDict({"observation": torch.zeros(13), "reference": torch.zeros(6)})
    td["observation"][6] = 1.0  # turned by half a turn about x
    td["mpc"] = TensorDict({"states": torch.zeros(21, 13), "actions": torch.zeros(20, 4)})
    assert planner.action_spec.is_in(planner(td)["action"])
