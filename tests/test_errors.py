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
