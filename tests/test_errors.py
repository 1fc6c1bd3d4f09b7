"""Errors name what was given and what is allowed."""

import math
import re

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


def test_what_is_allowed_comes_back():
    assert check_number("lr", 1e-300, low=0, open_low=True) == 1e-300
    assert check_count("horizon", 1) == 1 and check_count("seed", 0, low=0) == 0
    assert check_choice("by", "step", iter(["progress", "step"])) == "step"
    assert check_flag("enabled", False) is False


BY = {"allowed": ["progress", "step"]}
REFUSED = [
    *((check_number, x, {"low": 0, "high": 1}, r"\[0, 1\]") for x in (-1e-9, 1.0001, True, "0.5")),
    *((check_number, x, {"low": 0, "high": 1}, r"\[0, 1\]") for x in (math.nan, math.inf, None)),
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
