"""Differences and sums where some coordinates are angles."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from afm_rl.errors import ConfigurationError
from afm_rl.spaces.manifold import Manifold, wrap_angle

REALS = st.floats(-1e3, 1e3)
ANGLES = st.floats(-math.pi, math.pi, exclude_max=True)
SPACE = Manifold(3, angles=[2])


def poses():
    pairs = st.tuples(REALS, REALS, ANGLES)
    return pairs.map(lambda pose: torch.tensor(pose, dtype=torch.float64))


@given(st.floats(-1e4, 1e4))
def test_wrapping_keeps_the_direction_and_ends_in_one_turn(angle):
    wrapped = float(wrap_angle(torch.tensor(angle, dtype=torch.float64)))
    assert -math.pi <= wrapped <= math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [(0, 0), (3, 3), (4, 4 - 2 * math.pi), (-4, 2 * math.pi - 4), (math.pi, -math.pi)],
)
def test_wrapping_by_hand(angle, wrapped):
    exact = torch.tensor(angle, dtype=torch.float64)
    assert float(wrap_angle(exact)) == pytest.approx(wrapped, abs=1e-12)


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


@given(poses(), poses())
def test_the_difference_is_the_shortest_turn(state, origin):
    turn = float(SPACE.difference(state, origin)[2])
    gap = abs(float(state[2] - origin[2]))
    assert abs(turn) == pytest.approx(min(gap, 2 * math.pi - gap), abs=1e-9)


def test_only_angles_wrap_and_batches_broadcast():
    space = Manifold(4, angles=[1, 3])
    change = space.difference(torch.full((5, 2, 4), 4.0), torch.zeros(2, 4))
    assert change.shape == (5, 2, 4)
    turned = 4 - 2 * math.pi
    torch.testing.assert_close(change[0, 0], torch.tensor([4.0, turned, 4.0, turned]))
    flat = Manifold(2)
    assert torch.equal(flat.add(torch.full((2,), 9.0), torch.ones(2)), torch.full((2,), 10.0))


def test_the_sizes_are_known_and_nothing_is_stored():
    assert (SPACE.size, SPACE.tangent_size, len(SPACE.state_dict())) == (3, 3, 0)


@pytest.mark.parametrize(("size", "angles"), [(0, []), (2.0, []), (3, [3]), (3, [-1])], ids=str)
def test_impossible_spaces_are_refused(size, angles):
    with pytest.raises(ConfigurationError, match="manifold"):
        Manifold(size, angles)
