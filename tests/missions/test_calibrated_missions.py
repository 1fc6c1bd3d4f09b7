"""Missions whose model is calibrated on the way."""

import pytest
from harness import assert_same_results

from afm_rl.missions import build, run


def test_nothing_changes_where_nothing_changed(make_agent, ring):
    settings = {"tracks": [ring], "regimes": "none", "seeds": 2, "budget": 20}
    assert_same_results(
        *(run(make_agent(f"method={name}", **settings)) for name in ("rls", "physics")), "method"
    )


@pytest.mark.parametrize("method", ["rls", "oracle"])
def test_an_ensemble_is_trained_once_whatever_is_in_front_of_it(configure, method):
    parts = [f"method={method}", "dynamics@dynamics.base=pe"], ["method=frozen_pe"]
    cfg = [configure(*chosen) for chosen in parts]
    one, other = ([(t.title, t.settings) for t in build(c).trainings] for c in cfg)
    assert one == other and len(one) == 1
