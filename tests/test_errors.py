"""Errors name what was given and what is allowed."""

import math

import pytest

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


@pytest.mark.parametrize("kind", [ArtefactError, ConfigurationError, NonFiniteError])
def test_every_error_is_one_of_ours_and_a_value_error(kind):
    assert issubclass(kind, AFMError) and issubclass(kind, ValueError)


@pytest.mark.parametrize("value", [0, 0.0, 1, 1.0, 0.5])
def test_a_number_in_its_range_comes_back_as_a_float(value):
    result = check_number("beta", value, low=0, high=1)
    assert result == value and type(result) is float


@pytest.mark.parametrize("value", [-1e-9, 1.0001, math.nan, math.inf, -math.inf, True, "0.5", None])
def test_any_other_number_is_refused_by_name_and_range(value):
    with pytest.raises(ConfigurationError, match=r"beta=.*\[0, 1\]") as caught:
        check_number("beta", value, low=0, high=1)
    assert repr(value) in str(caught.value)


def test_an_open_range_excludes_its_lower_end():
    assert check_number("lr", 1e-300, low=0, open_low=True) == 1e-300
    with pytest.raises(ConfigurationError, match=r"lr=0: .*\(0, inf\]"):
        check_number("lr", 0, low=0, open_low=True)


@pytest.mark.parametrize("value", [0, -3, 2.0, True, "4", None])
def test_a_count_is_a_whole_number_of_at_least_one(value):
    assert check_count("horizon", 1) == 1
    with pytest.raises(ConfigurationError, match="horizon=.* at least 1"):
        check_count("horizon", value)


def test_the_least_count_can_be_set():
    assert check_count("seed", 0, low=0) == 0
    with pytest.raises(ConfigurationError, match="batch=1: .* at least 2"):
        check_count("batch", 1, low=2)


def test_a_choice_lists_what_is_allowed():
    assert check_choice("by", "step", iter(["progress", "step"])) == "step"
    with pytest.raises(ConfigurationError, match="by='steps': expected one of progress, step"):
        check_choice("by", "steps", iter(["progress", "step"]))


@pytest.mark.parametrize("value", [0, 1, "true", None])
def test_flags_are_true_or_false(value):
    assert check_flag("enabled", False) is False
    with pytest.raises(ConfigurationError, match="enabled=.*true or false"):
        check_flag("enabled", value)
