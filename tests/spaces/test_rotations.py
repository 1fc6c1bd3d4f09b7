"""Quaternions and the rigid body's state space, against SciPy."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from afm_rl.spaces.rotations import (
    RigidBodySpace,
    body_z_axis,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_log,
    quaternion_multiply,
    quaternion_normalise,
    rotate,
    rotate_slope,
)

IDENTITY = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
ANGLES = [0.0, 1e-12, 1e-8, 9.99e-4, 1.01e-3, 0.1, 1.0, 3.0, math.pi - 1e-6]


def turns(*batch):
    return quaternion_normalise(torch.randn(*batch, 4, dtype=torch.float64))


def states(*batch):
    state = torch.randn(*batch, 13, dtype=torch.float64)
    state[..., 6:10] = turns(*batch)
    return state


def test_products_and_rotations_are_those_of_scipy():
    first, second, vector = turns(20), turns(20), torch.randn(20, 3, dtype=torch.float64)
    one, two = (Rotation.from_quat(x.numpy()) for x in (first, second))
    product = (one * two).as_quat()
    ours = quaternion_multiply(first, second).numpy()
    np.testing.assert_allclose(ours * np.sign((ours * product).sum(-1, keepdims=True)), product)
    np.testing.assert_allclose(rotate(first, vector).numpy(), one.apply(vector.numpy()))
    np.testing.assert_allclose(body_z_axis(first).numpy(), one.as_matrix()[..., 2], atol=1e-15)
    back = quaternion_multiply(quaternion_conjugate(first), first)
    torch.testing.assert_close(back, IDENTITY.expand(20, 4))


def test_functions_broadcast():
    assert quaternion_multiply(turns(5, 1), turns(3)).shape == (5, 3, 4)
    assert rotate(turns(5, 1), torch.ones(3, 3, dtype=torch.float64)).shape == (5, 3, 3)


@pytest.mark.parametrize("angle", ANGLES)
def test_logarithm_and_exponential_are_those_of_scipy(angle):
    axis = torch.nn.functional.normalize(torch.randn(10, 3, dtype=torch.float64), dim=-1)
    vectors = axis * angle
    quaternions = quaternion_exp(vectors)
    expected = Rotation.from_rotvec(vectors.numpy()).as_quat()
    np.testing.assert_allclose(quaternions.numpy(), expected, rtol=1e-14, atol=1e-15)
    for sign in (1, -1):  # the same rotation
        torch.testing.assert_close(quaternion_log(sign * quaternions), vectors)


@pytest.mark.parametrize("angle", ANGLES[:-1])
def test_single_precision_keeps_its_type_and_digits(angle):
    vectors = torch.tensor([0.36, 0.48, 0.8]) * angle
    there = quaternion_log(quaternion_exp(vectors))
    assert there.dtype is torch.float32
    torch.testing.assert_close(there, vectors, rtol=3e-6, atol=1e-30)


def test_both_modes_of_differentiation_work_at_the_identity():
    zero, axes = torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    half = torch.cat([axes / 2, axes.new_zeros(1, 3)])
    two = torch.cat([2 * axes, axes.new_zeros(3, 1)], 1)
    for mode in (torch.func.jacfwd, torch.func.jacrev):
        torch.testing.assert_close(mode(quaternion_exp)(zero), half)
        torch.testing.assert_close(mode(quaternion_log)(IDENTITY), two)


@pytest.mark.parametrize("angle", [0.0, 5e-4, 2e-3, 1.0, 3.0])
def test_derivatives_match_finite_differences(angle):
    vector = torch.tensor([0.36, 0.48, 0.8], dtype=torch.float64) * angle
    vector.requires_grad_()
    torch.autograd.gradcheck(quaternion_exp, vector, check_forward_ad=True)
    both = lambda x: quaternion_log(quaternion_exp(x))  # noqa: E731
    torch.autograd.gradcheck(both, vector, check_forward_ad=True)


@pytest.mark.parametrize("batch", [(), (7,), (2, 3)])
def test_the_derivative_of_turned_vectors(batch):
    quaternion, vector = (torch.randn(*batch, size, dtype=torch.float64) for size in (4, 3))
    for slope, q, x in zip(
        *(rotate_slope(quaternion, vector).reshape(-1, 3, 4), quaternion.reshape(-1, 4)),
        vector.reshape(-1, 3),
        strict=True,
    ):
        torch.testing.assert_close(slope, torch.func.jacfwd(rotate)(q, x))


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
