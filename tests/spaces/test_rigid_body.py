"""The state space of a rigid body, against SciPy."""

import math

import pytest
import roma
import torch
from scipy.spatial.transform import Rotation

from afm_rl.spaces.manifold import RigidBodySpace

ANGLES = [0.0, 1e-12, 1e-8, 1e-3, 0.1, 1.0, 3.0, math.pi - 1e-6]


def states(*batch):
    state = torch.randn(*batch, 13, dtype=torch.float64)
    state[..., 6:10] = roma.quat_normalize(state[..., 6:10])
    return state


@pytest.mark.parametrize("angle", ANGLES)
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


def test_the_space_has_thirteen_coordinates_and_twelve_directions():
    space = RigidBodySpace()
    assert (space.size, space.tangent_size) == (13, 12)


def test_numbers_from_a_box_become_states():
    raw = torch.rand(50, 13, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = RigidBodySpace().project(raw)
    torch.testing.assert_close(found[:, 6:10].norm(dim=-1), torch.ones(50).double())
    kept = [*range(6), *range(10, 13)]
    assert torch.equal(found[:, kept], raw[:, kept])
    torch.testing.assert_close(RigidBodySpace().project(found), found)
