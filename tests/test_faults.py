"""Which readings are trusted, and which actions pass."""

import copy
import math
import re

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from afm_rl.dynamics import Dubins
from afm_rl.errors import (
    AFMError,
    ArtefactError,
    ConfigurationError,
    NonFiniteError,
    check_choice,
    check_count,
    check_flag,
    check_number,
)
from afm_rl.faults import PATIENCE, check_numbers, count_repeats, safe_action, trusted
from afm_rl.learning import GaussianNLLLoss, OnlineUpdater, ResetAdam

WILD = st.one_of(st.floats(width=32), st.sampled_from([math.nan, math.inf, -math.inf, 1e30, -0.0]))


def believed(readings, stamps=None, patience=PATIENCE):
    """Which transitions between readings ``(T, S)`` may be learned from."""
    count, answer = torch.tensor(0), []
    for t in range(len(readings) - 1):
        pair = () if stamps is None else (stamps[t + 1], stamps[t])
        after = count_repeats(readings[t + 1], readings[t], count, *pair)
        ends = trusted(readings[t], count, patience), trusted(readings[t + 1], after, patience)
        answer.append(bool(ends[0] & ends[1]))
        count = after
    return answer


def noisy(steps):
    return torch.randn(steps, 3, generator=torch.Generator().manual_seed(0)).cumsum(0)


@pytest.mark.parametrize("frozen", [1, 2, 10])
def test_nothing_is_believed_of_a_frozen_sensor_and_of_the_jump_after_it(frozen):
    readings = noisy(30)
    readings[6 : 6 + frozen] = readings[5]
    wrong = [step for step, sound in enumerate(believed(readings)) if not sound]
    assert wrong == list(range(5, 6 + frozen))  # the transitions into stale readings, and out


@pytest.mark.parametrize("fault", [math.nan, math.inf, -1e30])
def test_a_bad_reading_spoils_two_transitions(fault):
    readings = noisy(9)
    readings[4, 1] = fault
    assert believed(readings) == [True] * 3 + [False] * 2 + [True] * 3


def test_a_dead_robot_is_believed_after_a_while():
    readings = torch.cat([noisy(3), noisy(3)[-1:].expand(60, 3), noisy(3)])
    sound = believed(readings)
    assert sound[:2] == [True] * 2
    assert sound[2 : 3 + PATIENCE] == [False] * (PATIENCE + 1)
    assert all(sound[3 + PATIENCE :])
    assert not any(believed(readings, patience=math.inf)[2:-2])


def test_a_time_stamp_decides_alone():
    dead, clock = torch.ones(40, 3), torch.arange(40)
    assert all(believed(dead, clock, math.inf))
    clock[30:34] = clock[29]
    alive = [step for step, sound in enumerate(believed(noisy(40), clock, math.inf)) if not sound]
    assert alive == [29, 30, 31, 32, 33]


@settings(max_examples=300, deadline=None)
@given(st.lists(WILD, min_size=6, max_size=6), st.lists(WILD, min_size=2, max_size=2))
def test_only_finite_actions_inside_the_box_pass(actions, last):
    low, high = torch.tensor([-1.0, 0.25]), torch.tensor([1.0, 0.5])
    given, before = torch.tensor(actions).reshape(3, 2), torch.tensor(last).expand(3, 2)
    executed, held = safe_action(given, low, high, before)
    assert ((executed >= low) & (executed <= high)).all()
    assert torch.equal(held, ~given.isfinite().all(-1))
    inside = ~held & ((given >= low) & (given <= high)).all(-1)
    assert torch.equal(executed[inside], given[inside])


@pytest.mark.parametrize(
    ("entry", "found"),
    [
        (torch.zeros(4, 2), "torch.float32 (4, 2)"),
        (torch.zeros(4, 3, dtype=torch.complex64), "torch.complex64 (4, 3)"),
        (torch.zeros(4, 3, dtype=torch.bool), "torch.bool (4, 3)"),
        ([0.0, 0.0, 0.0], "list"),
        (None, "NoneType"),
    ],
)
def test_what_is_no_tensor_of_real_numbers_is_refused_by_its_key(entry, found):
    words = re.escape(f"('robot', 'speed'): {found}, expected real numbers (4, 3)")
    with pytest.raises(ConfigurationError, match=words):
        check_numbers(("robot", "speed"), entry, (4, 3))


@pytest.mark.parametrize("shape", [(4, 3), torch.Size([4, 3]), None])
@pytest.mark.parametrize("kind", [torch.float16, torch.float64, torch.int64])
def test_real_numbers_of_a_shape_are_handed_back(kind, shape):
    speed = torch.zeros(4, 3, dtype=kind)
    assert check_numbers("speed", speed, shape) is speed


@pytest.mark.slow
def test_outliers_do_little_harm(trained_ensemble, transitions):
    error = {}
    for share in (0.0, 0.01):
        model = copy.deepcopy(trained_ensemble)
        updater = OnlineUpdater(GaussianNLLLoss(model), lambda p: ResetAdam(p, lr=1e-4))
        dice = torch.Generator().manual_seed(0)
        gain = torch.tensor([0.6, 1.2])
        state, action = transitions(1000, seed=1)
        change = Dubins()(state, gain * action) - state
        wild = torch.rand(1000, generator=dice) < share
        change = torch.where(wild.unsqueeze(-1), 100 * change, change)
        rows = TensorDict({"observation": state, "action": action}, [1000])
        rows["next", "observation"] = state + change
        for row in rows.split(1):
            updater(row)
        state, action = transitions(500, seed=2)
        miss = model.manifold.difference(model(state, action), Dubins()(state, gain * action))
        error[share] = float(miss.square().mean().sqrt())
        assert updater.refused == 0
    assert error[0.01] < 1.5 * error[0.0]


@pytest.mark.parametrize("kind", [ArtefactError, ConfigurationError, NonFiniteError])
def test_every_error_is_one_of_ours_and_a_value_error(kind):
    assert issubclass(kind, AFMError) and issubclass(kind, ValueError)


BY = {"allowed": ["progress", "step"]}
REFUSED = [
    *((check_number, x, {"low": 0, "high": 1}, r"\[0, 1\]") for x in (1.0001, math.nan, None)),
    (check_number, 0, {"low": 0, "open_low": True}, r"\(0, inf\]"),
    *((check_count, x, {}, "at least 1") for x in (0, -3, 2.0, True, "4", None)),
    (check_count, 1, {"low": 2}, "at least 2"),
    (check_choice, "steps", BY, "one of progress, step"),
    *((check_flag, x, {}, "true or false") for x in (0, 1, "true", None)),
]


@pytest.mark.parametrize(("check", "value", "settings", "said"), REFUSED)
def test_any_other_value_is_refused_by_name_and_range(check, value, settings, said):
    with pytest.raises(ConfigurationError, match=f"^name={re.escape(repr(value))}: .*{said}"):
        check("name", value, **settings)
