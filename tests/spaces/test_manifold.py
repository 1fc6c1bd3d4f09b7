"""State spaces: differences and sums with angles, rigid bodies against SciPy; draws of points."""

import math

import pytest
import roma
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from afm_rl.errors import ConfigurationError
from afm_rl.spaces.manifold import Manifold, RigidBodySpace, draw_states, uniform, wrap_angle

REALS = st.floats(-1e3, 1e3)
ANGLES = st.floats(-math.pi, math.pi, exclude_max=True)
SPACE = Manifold(3, angles=[2])
TURNS = [0.0, 1e-12, 1e-8, 1e-3, 0.1, 1.0, 3.0, math.pi - 1e-6]


def poses():
    pairs = st.tuples(REALS, REALS, ANGLES)
    return pairs.map(lambda pose: torch.tensor(pose, dtype=torch.float64))


@given(st.floats(-1e4, 1e4))
def test_wrapping_keeps_the_direction_and_ends_in_one_turn(angle):
    wrapped = float(wrap_angle(torch.tensor(angle, dtype=torch.float64)))
    assert -math.pi <= wrapped <= math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)


@given(poses(), poses())
def test_adding_a_difference_leads_back(state, origin):
    reached = SPACE.add(origin, SPACE.difference(state, origin))
    torch.testing.assert_close(reached[:2], state[:2])
    assert abs(float(wrap_angle(reached[2] - state[2]))) < 1e-9


@given(poses(), st.tuples(REALS, REALS, st.floats(-3.1, 3.1)))
def test_the_difference_of_a_sum_is_the_step(origin, step):
    step = torch.tensor(step, dtype=torch.float64)
    reached = SPACE.add(origin, step)
    assert -math.pi <= float(reached[2]) <= math.pi
    torch.testing.assert_close(SPACE.difference(reached, origin), step, rtol=1e-9, atol=1e-9)


def test_only_angles_wrap_and_batches_broadcast():
    space = Manifold(4, angles=[1, 3])
    change = space.difference(torch.full((5, 2, 4), 4.0), torch.zeros(2, 4))
    assert change.shape == (5, 2, 4)
    turned = 4 - 2 * math.pi
    torch.testing.assert_close(change[0, 0], torch.tensor([4.0, turned, 4.0, turned]))
    flat = Manifold(2)
    assert torch.equal(flat.add(torch.full((2,), 9.0), torch.ones(2)), torch.full((2,), 10.0))


@pytest.mark.parametrize(("size", "angles"), [(0, []), (2.0, []), (3, [3]), (3, [-1])], ids=str)
def test_impossible_spaces_are_refused(size, angles):
    with pytest.raises(ConfigurationError, match="manifold"):
        Manifold(size, angles)


def states(*batch):
    state = torch.randn(*batch, 13, dtype=torch.float64)
    state[..., 6:10] = roma.quat_normalize(state[..., 6:10])
    return state


@pytest.mark.parametrize("angle", TURNS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_turns_of_any_size_keep_their_digits_and_both_modes_of_differentiation(angle, dtype):
    space, origin, tangent = RigidBodySpace(), states().to(dtype), torch.zeros(12, dtype=dtype)
    tangent[6:9] = torch.tensor([0.36, 0.48, 0.8], dtype=dtype) * angle

    def there_and_back(tangent):
        return space.difference(space.add(origin, tangent), origin)

    eps = torch.finfo(dtype).eps
    torch.testing.assert_close(there_and_back(tangent), tangent, rtol=30 * eps, atol=10 * eps)
    for mode in (torch.func.jacfwd, torch.func.jacrev):
        slope = mode(there_and_back)(tangent)
        limit = 1e4 * eps if angle < 3.1 else 1e-3  # near half a turn a step may lead beyond it
        torch.testing.assert_close(slope, torch.eye(12, dtype=dtype), rtol=0, atol=limit)


@pytest.mark.parametrize("batch", [(), (7,), (2, 3)])
def test_differences_lead_from_one_state_to_the_other(batch):
    space, state, origin = RigidBodySpace(), states(*batch), states(*batch)
    tangent = space.difference(state, origin)
    assert tangent.shape == (*batch, 12)
    there = space.add(origin, tangent)
    sign = torch.sign((there[..., 6:10] * state[..., 6:10]).sum(-1, keepdim=True))
    torch.testing.assert_close(
        torch.cat([there[..., :6], there[..., 10:]], -1),
        torch.cat([state[..., :6], state[..., 10:]], -1),
    )
    torch.testing.assert_close(sign * there[..., 6:10], state[..., 6:10])


def test_the_sign_of_a_quaternion_makes_no_difference():
    space, state, origin = RigidBodySpace(), states(), states()
    flipped = state.clone()
    flipped[6:10] *= -1
    torch.testing.assert_close(space.difference(flipped, origin), space.difference(state, origin))
    assert space.difference(origin, origin).abs().max() < 1e-15


def test_tangents_turn_in_the_body_frame():
    space, origin = RigidBodySpace(), states()
    tangent = torch.zeros(12, dtype=torch.float64)
    tangent[6:9] = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    turned = Rotation.from_quat(origin[6:10].numpy()) * Rotation.from_rotvec([0.1, -0.2, 0.3])
    ours = Rotation.from_quat(space.add(origin, tangent)[6:10].numpy())
    assert (turned.inv() * ours).magnitude() < 1e-14


def test_numbers_from_a_box_become_states():
    raw = torch.rand(50, 13, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = RigidBodySpace().project(raw)
    torch.testing.assert_close(found[:, 6:10].norm(dim=-1), torch.ones(50).double())
    kept = [*range(6), *range(10, 13)]
    assert torch.equal(found[:, kept], raw[:, kept])
    torch.testing.assert_close(RigidBodySpace().project(found), found)


def test_points_fill_their_box_evenly():
    low, high = torch.tensor([-1.0, 5.0]), torch.tensor([3.0, 5.5])
    points = uniform(low, high, 20_000, torch.Generator().manual_seed(0))
    assert points.shape == (20_000, 2)
    assert (points >= low).all() and (points <= high).all()
    torch.testing.assert_close(points.mean(0), (low + high) / 2, rtol=0, atol=0.03)
    torch.testing.assert_close(points.std(0), (high - low) / 12**0.5, rtol=0.02, atol=0)


def test_states_come_from_a_pool_or_a_box():
    pool = torch.arange(10.0).unsqueeze(-1)
    drawn = draw_states(pool, 500, torch.Generator().manual_seed(0))
    assert drawn.shape == (500, 1) and drawn.unique().tolist() == list(range(10))
    box = torch.zeros(1), torch.ones(1)
    same = [torch.Generator().manual_seed(1) for _ in range(2)]
    assert torch.equal(draw_states(box, 9, same[0]), uniform(*box, 9, same[1]))
