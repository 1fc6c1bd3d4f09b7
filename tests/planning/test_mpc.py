"""Model predictive control: against an exact solver, and in flights."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from afm_rl.dynamics import Dubins, KnownDynamics
from afm_rl.dynamics.quadrotor import Quadrotor
from afm_rl.envs import Circle, CrazyflieTrack
from afm_rl.errors import ConfigurationError
from afm_rl.planning import MPC, PlanningEnv, TrackingCost, mpc
from afm_rl.spaces.airframe import QuadrotorBody
from afm_rl.spaces.manifold import Manifold

DT, HORIZON = 0.1, 12


def pendulum_step(state, action):
    """Swing a damped pendulum: angle (rad), rate (rad/s); torque."""
    angle, rate = state.unbind(-1)
    rate = rate + DT * (4.0 * angle.sin() - 0.2 * rate + action[..., 0])
    return torch.stack([angle + DT * rate, rate], -1)


@pytest.fixture
def pendulum():
    """A pendulum that is to stand up (angle 0), in double precision, with a weak motor."""
    model = KnownDynamics(pendulum_step, Manifold(2), 1)
    cost = TrackingCost([4.0, 0.1], [0.01], [0])
    bound = torch.tensor([5.0]).double()
    return PlanningEnv(model, cost, -bound, bound)


def car(box, dynamics=None, **settings):
    cost = TrackingCost([1.0, 1.0, 0.0], [0.02, 0.02], [0, 1])
    return MPC(PlanningEnv(dynamics or Dubins(), cost, *box), **{"horizon": 6, **settings})


def situation(planner, *batch, seed=0, memory=0.1, dtype=None):
    """Where the robots are, where they shall be, and what they planned before."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*batch, *shape, generator=generator)

    size, inputs = planner.env.dynamics.state_size, planner.env.dynamics.action_size
    td = TensorDict({"observation": 0.5 * draw(size)}, batch)
    td["reference"] = draw(planner.env.cost.in_sizes[0])
    td["mpc", "states"] = memory * draw(planner.horizon + 1, size)
    td["mpc", "actions"] = memory * draw(planner.horizon, inputs)
    return td if dtype is None else td.to(dtype)


def plan(planner, td):
    out = planner(td.clone())["next", "mpc"]
    return out["states"], out["actions"]


def ipopt(casadi, start, guess):
    """Solve the pendulum's problem exactly, by multiple shooting; return states, actions."""
    opti = casadi.Opti()
    x, u = opti.variable(2, HORIZON + 1), opti.variable(1, HORIZON)
    cost = 0.01 * casadi.sumsqr(u) + 4.0 * casadi.sumsqr(x[0, :]) + 0.1 * casadi.sumsqr(x[1, :])
    opti.minimize(cost)
    opti.subject_to(x[:, 0] == start)
    for k in range(HORIZON):
        rate = x[1, k] + DT * (4.0 * casadi.sin(x[0, k]) - 0.2 * x[1, k] + u[k])
        opti.subject_to(x[1, k + 1] == rate)
        opti.subject_to(x[0, k + 1] == x[0, k] + DT * rate)
    opti.subject_to(opti.bounded(-5.0, u, 5.0))
    for variable, value in zip((x, u), guess, strict=True):
        opti.set_initial(variable, value.numpy().T)
    quiet = {"print_level": 0, "tol": 1e-10, "sb": "yes"}
    opti.solver("ipopt", {"print_time": False}, quiet)
    solution = opti.solve()
    return np.asarray(solution.value(x)).T, np.asarray(solution.value(u))


@pytest.mark.parametrize(("iterations", "tolerance"), [(20, 1e-6), (1, 0.05)])
def test_a_flight_equals_an_exact_solver(pendulum, iterations, tolerance, monkeypatch):
    monkeypatch.setattr(mpc, "FIRST_ITERATIONS", 30)
    casadi = pytest.importorskip("casadi")
    planner = MPC(pendulum, HORIZON, iterations)
    td = situation(planner, memory=0.0, dtype=torch.float64)
    td["observation"], td["reference"] = torch.tensor([0.9, 0.3]).double(), torch.zeros(1)
    saturated = 0
    for _ in range(6):
        states, actions = plan(planner, td)
        exact_states, exact_actions = ipopt(casadi, td["observation"].numpy(), (states, actions))
        np.testing.assert_allclose(actions[:, 0], exact_actions, atol=tolerance)
        np.testing.assert_allclose(states, exact_states, atol=tolerance)
        saturated += int((actions.abs() == 5.0).sum())
        td["observation"] = pendulum.dynamics(td["observation"], actions[0])
        td["mpc"] = TensorDict({"states": states, "actions": actions})
    assert 0 < saturated < 60 and planner.inexact == planner.discarded == 0


@pytest.mark.parametrize("batch", [(4,), (2, 3)], ids=str)
def test_a_batch_of_flights_equals_single_ones(box, batch):
    planner = car(box, iterations=2)
    td = situation(planner, *batch)
    td["mpc", "states"][0] = td["mpc", "actions"][0] = 0.0  # these have just begun
    states, actions = plan(planner, td)
    assert states.shape == (*batch, 7, 3) and actions.shape == (*batch, 6, 2)
    for index in np.ndindex(*batch):
        alone = plan(planner, td[index])
        torch.testing.assert_close(alone[0], states[index], rtol=0, atol=1e-5)
        torch.testing.assert_close(alone[1], actions[index], rtol=0, atol=1e-5)


@pytest.mark.parametrize("angle", [0.0, 2 * math.pi, -2 * math.pi])
def test_headings_may_be_written_in_any_way(box, angle):
    planner, td = car(box), None
    td = situation(planner, 5)
    expected = planner(td.clone())["action"]
    td["mpc", "states"][..., 2] += angle
    torch.testing.assert_close(planner(td)["action"], expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("bounded", [None, [0], []], ids=str)
def test_bounds_hold_for_the_components_chosen(box, bounded):
    planner = car(box, bounded=bounded, iterations=3)
    td = situation(planner, 20)
    td["reference"] *= 20
    out = planner(td)
    assert all(planner.action_spec.is_in(action) for action in out["action"])
    outside = (out["next", "mpc", "actions"].abs() > box[1] + 1e-6).flatten(0, 1).any(0)
    free = [] if bounded is None else [i for i in range(2) if i not in bounded]
    assert outside.nonzero().flatten().tolist() == free


@pytest.mark.parametrize("learnt", [False, True])
def test_it_drives_to_the_goal(box, trained_ensemble, learnt):
    truth = Dubins()
    planner = car(box, trained_ensemble if learnt else truth, horizon=10)
    td = situation(planner, 3, memory=0.0)
    td["observation"] = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [1.0, 1.0, -1.5]])
    td["reference"] = torch.tensor([[2.0, 1.0], [2.0, 0.0], [-1.0, 0.0]])
    for _ in range(30):
        td = planner(td)
        assert not td["action"].requires_grad
        td["observation"] = truth(td["observation"], td["action"])
        td["mpc"] = td["next", "mpc"]
    assert ((td["observation"][:, :2] - td["reference"]).norm(dim=-1) < 0.3).all()
    assert planner.discarded == 0


def test_missions_with_models_of_their_own_plan_with_them(box, make_ensemble):
    shared = make_ensemble()
    planner, td = car(box, shared), situation(car(box), 3)
    expected = planner(td.clone())["action"]
    shared.expand_(3)
    torch.testing.assert_close(planner(td.clone())["action"], expected, rtol=0, atol=1e-5)
    shared.biases[-1].data[1] += 1.0
    changed = (planner(td)["action"] - expected).abs().amax(-1) > 1e-4
    assert changed.tolist() == [False, True, False]


@pytest.mark.parametrize("fault", [math.nan, math.inf])
@pytest.mark.parametrize("cold", [False, True])
@pytest.mark.parametrize("where", ["observation", "reference"])
def test_without_a_finite_solution_the_previous_plan_stands(box, fault, cold, where):
    planner = car(box)
    td = situation(planner, 3)
    if cold:
        td["mpc"].zero_()
    expected = plan(planner, td)
    td[where][1] = fault
    with pytest.warns(UserWarning, match="no finite solution for 1 of 3 plans"):
        states, actions = plan(planner, td)
    assert planner.discarded == 1
    for found, name, good in zip((states, actions), ("states", "actions"), expected, strict=True):
        old = td["mpc", name][1]
        assert torch.equal(found[1], torch.cat([old[1:], old[-1:]]))
        torch.testing.assert_close(found[::2], good[::2])
    with pytest.warns(UserWarning, match="no finite"):
        assert planner.planning(td).isfinite().all()


def test_new_flights_iterate_five_times(pendulum, monkeypatch):
    td = situation(MPC(pendulum, HORIZON), 2, dtype=torch.float64)
    td["mpc", "states"][0] = td["mpc", "actions"][0] = 0.0
    many = plan(MPC(pendulum, HORIZON), td)[1]
    monkeypatch.setattr(mpc, "FIRST_ITERATIONS", 1)
    few = plan(MPC(pendulum, HORIZON), td)[1]
    torch.testing.assert_close(few[1], many[1])
    assert (few[0] - many[0]).abs().max() > 1e-3


def test_plans_that_are_not_minima_are_counted(box, monkeypatch):
    planner = car(box)
    td = situation(planner, 3)
    td["reference"] *= 50
    monkeypatch.setattr(mpc, "solve_lq", partial(mpc.solve_lq, sweeps=1))
    actions = plan(planner, td)[1]
    assert planner.inexact == 3
    assert (actions.abs() <= box[1]).all()


@pytest.mark.parametrize("shape", [(3, 6, 2), (3, 8, 2), (3, 3)], ids=str)
def test_references_of_another_shape_are_refused(box, shape):
    planner = car(box)
    td = situation(planner, 3).set("reference", torch.zeros(shape))
    with pytest.raises(ConfigurationError, match=r"expected \(3, 2\), held .* \(3, 7, 2\)"):
        planner(td)
    with pytest.raises(ConfigurationError, match="reads 'reference', but the environment gives"):
        planner(td.exclude("reference"))


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
