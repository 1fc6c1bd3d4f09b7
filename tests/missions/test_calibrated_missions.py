"""Missions whose model is calibrated on the way."""

import pandas as pd
import pytest

from afm_rl.missions import build, run


def same(left, right):
    for one, other in ((left.missions, right.missions), (left.steps, right.steps)):
        one, other = (t.drop(columns=["seconds", "method"], errors="ignore") for t in (one, other))
        pd.testing.assert_frame_equal(one, other, check_exact=True)


def test_nothing_changes_where_nothing_changed(make_agent, ring):
    settings = {"tracks": [ring], "regimes": "none", "seeds": 2, "budget": 20}
    same(*(run(make_agent(f"method={name}", **settings)) for name in ("rls", "physics")))


@pytest.mark.parametrize("method", ["rls", "oracle"])
def test_an_ensemble_is_trained_once_whatever_is_in_front_of_it(configure, method):
    parts = [f"method={method}", "dynamics@dynamics.base=pe"], ["method=frozen_pe"]
    cfg = [configure(*chosen) for chosen in parts]
    one, other = ([(t.title, t.settings) for t in build(c).trainings] for c in cfg)
    assert one == other and len(one) == 1
