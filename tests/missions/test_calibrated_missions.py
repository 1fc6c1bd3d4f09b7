"""Missions whose model is calibrated on the way."""

import pandas as pd
import pytest

from afm_rl.missions import build, run
from afm_rl.missions.run import Stopped


def same(left, right):
    for one, other in ((left.missions, right.missions), (left.steps, right.steps)):
        one, other = (t.drop(columns=["seconds", "method"], errors="ignore") for t in (one, other))
        pd.testing.assert_frame_equal(one, other, check_exact=True)


def test_nothing_changes_where_nothing_changed(make_agent, ring):
    settings = {"tracks": [ring], "regimes": "none", "seeds": 2, "budget": 20}
    same(*(run(make_agent(f"method={name}", **settings)) for name in ("rls", "physics")))


def test_interrupted_runs_are_bit_identical(make_agent, ring, spot, tmp_path):
    settings = {"tracks": [ring, spot], "seeds": 2, "budget": 18, "regimes": [{"v_gain": -1.0}]}
    settings["robot.schedule"] = {
        "_target_": "afm_rl.regimes.Schedule", "by": "step", "at": [6, 14],
    }  # fmt: skip
    whole, path = run(make_agent("method=rls", **settings)), tmp_path / "run.safetensors"
    with pytest.raises(Stopped):
        stopped = {"checkpoint": path, "stopped": lambda loop: loop.step == 11}
        run(make_agent("method=rls", **settings), **stopped)
    same(whole, run(make_agent("method=rls", **settings), checkpoint=path))
    assert whole.steps["regime_active"].any()
    late = whole.steps[(whole.steps["mission"] == 0) & whole.steps["t"].between(9, 13)]
    assert (late["error"] < 1e-2).all()  # learnt in two steps, with a little left


@pytest.mark.parametrize("method", ["rls_pe", "oracle_pe"])
def test_an_ensemble_is_trained_once_whatever_is_in_front_of_it(configure, method):
    cfg = [configure(f"method={name}") for name in (method, "frozen_pe")]
    one, other = ([(t.title, t.settings) for t in build(c).trainings] for c in cfg)
    assert one == other and len(one) == 1
