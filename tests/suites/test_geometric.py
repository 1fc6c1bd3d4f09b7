import math

import pytest
import roma
import torch
from flight.geometric import Gains, GeometricController, geometric_wrench
from harness import BOX, level, refused
from tensordict import TensorDict

from afm_rl.dynamics import Dubins, Quadrotor
from afm_rl.dynamics.quadrotor import quadrotor_path, quadrotor_step
from afm_rl.envs import Circle, CrazyflieTrack
from afm_rl.planning import GoalDistance, PlanningEnv
from afm_rl.spaces.airframe import QuadrotorBody, within_motors
from afm_rl.spaces.manifold import RigidBodySpace

BODY, DT = QuadrotorBody(), 0.05


def controller(model=None, **settings):
    model = model or Quadrotor()
    bounds = BODY.bounds if model.action_size == 4 else BOX
    return GeometricController(PlanningEnv(model, GoalDistance(), *bounds), **settings)


def steer(state, target=(0.0, 0.0, 0.0), **settings):
    """Return the wrench towards a place to hover at."""
    reference = torch.tensor([*target, 0.0, 0.0, 0.0]).to(state).expand(*state.shape[:-1], 6)
    td = TensorDict({"observation": state, "reference": reference}, state.shape[:-1])
    return controller(**settings)(td)["action"]


def fly(state, ticks, target=(0.0, 0.0, 0.0), mass=1.0, **settings):
    """Return the states ``(T + 1, *B, 13)`` of a flight, the action held for each tick."""
    body, path = QuadrotorBody(mass=BODY.mass * mass), [state]
    for _ in range(ticks):
        action = steer(path[-1], target, **settings)
        path.append(quadrotor_path(path[-1], action, DT, 25, body)[-1])
    return torch.stack(path)


def poles():
    """Return the eigenvalues of one sampled tick about hovering, on the tangent space."""
    space, origin = RigidBodySpace(), level(dtype=torch.float64)
    nominal = controller()
    gains = Gains(*(getattr(nominal, f"{name}_gains") for name in Gains._fields))
    still = torch.zeros(6, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)

    def tick(tangent):
        state = space.add(origin, tangent)
        action = geometric_wrench(state, *still, BODY, gains, 0.8)
        return space.difference(quadrotor_step(state, action, DT, 1, BODY), origin)

    steps = 1e-6 * torch.eye(12, dtype=torch.float64)
    columns = [(tick(step) - tick(-step)) / 2e-6 for step in steps]
    return torch.linalg.eigvals(torch.stack(columns, -1))


def test_the_default_gains_put_the_poles_where_the_docstring_says():
    found = poles()
    slow = math.exp(-5 * DT)  # four about x, four about y; repeated poles are ill-conditioned
    fast = math.exp(-10 * DT)
    distance = (found[:, None] - torch.tensor([slow, fast])).abs()
    assert (distance[:, 0] < 0.1).sum() >= 8 and (distance[:, 1] < 0.1).sum() >= 2
    assert found.abs().max() < 0.88


@pytest.mark.parametrize("mass", [0.4, 0.5, 1.0, 4 / 3, 1.7])
def test_wrong_mass_is_tolerated(mass):
    start = level(1)
    start[..., :3] = torch.tensor([0.3, -0.2, 0.1])
    end = fly(start, 200, mass=mass)[-40:]
    offset = -(mass - 1) * BODY.gravity / 62.0  # what the vertical gain leaves
    torch.testing.assert_close(end[..., 2], torch.full((40, 1), offset), atol=2e-3, rtol=0)
    assert end[..., :2].abs().max() < 0.01 and end[..., 3:6].abs().max() < 0.02


def test_a_step_is_made_good_without_much_overshoot():
    target = (1.0, -0.5, 0.3)
    flight = fly(level(), 80, target)
    torch.testing.assert_close(flight[-1, :3], torch.tensor(target), atol=0.01, rtol=0)
    share = flight[..., :3] / torch.tensor(target)
    assert share.max() < 1.1
    assert (flight[-1, 3:6].abs() < 0.05).all()


@pytest.mark.parametrize("turn", [[1.2, 0.0, 0.0], [0.0, -1.2, 0.5], [2.2, 0.0, 0.0], [0, 0, 2.5]])
def test_attitudes_far_from_level_are_recovered(turn):
    start = level()
    start[6:10] = roma.rotvec_to_unitquat(torch.tensor(turn))
    end = fly(start, 120)[-1]
    assert end[:3].norm() < 0.02 and roma.unitquat_to_rotmat(end[6:10])[2, 2] > 0.999


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_flights_of_a_batch_are_independent(batch):
    generator = torch.Generator().manual_seed(0)
    tangent = 0.2 * torch.randn(*batch, 12, generator=generator)
    state = RigidBodySpace().add(level(*batch), tangent)
    action = steer(state)
    assert action.shape == (*batch, 4)
    alone = [steer(one) for one in state.reshape(-1, 13)]
    alike = {"rtol": 1e-6, "atol": 1e-9}  # to rounding, which depends on processor and batch
    torch.testing.assert_close(action.reshape(-1, 4), torch.stack(alone), **alike)
    torch.testing.assert_close(within_motors(action, BODY), action)  # the motors can do it


def test_a_previewed_circle_is_followed_to_millimetres():
    env = CrazyflieTrack(
        [Circle(2.0, 0.8)], horizon=1, preview=True, start="moving", batch_size=(1,)
    )
    with torch.no_grad():
        rolled = env.rollout(100, controller(), tensordict=env.reset(), auto_reset=False)
    assert rolled["next", "square_error"].mean() < 2e-5  # m^2


def test_references_without_stages_are_taken_as_held():
    td = TensorDict({"observation": level(2), "reference": torch.ones(2, 6)}, [2])
    single = controller()(td.clone())["action"]
    td["reference"] = torch.ones(2, 2, 6)
    torch.testing.assert_close(single, controller()(td)["action"])


@refused(
    ({"dt": 0.0}, "planner.dt"),
    ({"horizon": 0}, "planner.horizon"),
    ({"position": [1.0, 1.0]}, "planner.position"),
    ({"position": 1.0}, "planner.position"),
    ({"velocity": [1.0, math.nan, 1.0]}, "planner.velocity"),
    ({"attitude": [-1.0, 1.0, 1.0]}, "planner.attitude"),
    ({"rate": "abc"}, "planner.rate"),
    ({"tilt": 1.6}, "planner.tilt"),
    ({"body": "crazyflie"}, "body"),
    ({"model": Dubins()}, "robot=quadrotor"),
)
def test_bad_settings_are_refused(setting):
    controller(**setting)
