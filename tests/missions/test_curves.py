"""TensorBoard reads the curves of missions while they run."""

import numpy as np
import pandas as pd
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from afm_rl.missions import run
from afm_rl.missions.curves import Curves
from afm_rl.missions.run import Stopped

ALWAYS = {
    *("correction/miss", "correction/unforeseen", "model/error", "model/loss", "model/innovation"),
    *("task/reached", "task/regime_active", "task/fault", "time/ms_per_step", "time/missions"),
}
CORRECTED = {"correction/corrected", "correction/noise", "correction/probability"}


def read(folder):
    """Return each curve, a value for each step."""
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    return {
        tag: pd.Series({event.step: event.value for event in events.Scalars(tag)})
        for tag in events.Tags()["scalars"]
    }


@pytest.mark.parametrize(
    ("method", "tags"), [("physics", ALWAYS), ("afm_physics", ALWAYS | CORRECTED)]
)
def test_curves_are_means_of_the_steps_and_seen_at_once(make_agent, tmp_path, method, tags):
    agent = make_agent(f"method={method}", seeds=2, budget=12, regimes=[{"v_gain": -1.0}])
    seen = []

    def look(loop):
        if loop.step == 7:  # while the missions run
            seen.append(read(tmp_path / "mine"))

    results = run(agent, stopped=look, curves=Curves(tmp_path / "mine", every=5))
    curves, steps = read(tmp_path / "mine"), results.steps
    assert seen[0].keys() == tags and [*seen[0]["model/error"].index] == [5]
    assert curves.keys() == tags | {"final/success_rate", "final/steps"}
    windows = steps.assign(window=5 * (steps["t"] // 5 + 1)).groupby("window")
    columns = {"correction/miss": "miss", "model/error": "error", "model/loss": "loss"}
    columns |= {"correction/corrected": "corrected"} if method == "afm_physics" else {}
    for tag, column in columns.items():
        assert [*curves[tag].index] == [5, 10]
        np.testing.assert_allclose(curves[tag], windows[column].mean()[:2], rtol=1e-5)
    reached = steps.groupby("t")["reached"].mean()
    np.testing.assert_allclose(curves["task/reached"], [reached[5], reached[10]])
    assert (curves["time/missions"] == 2).all() and (curves["time/ms_per_step"] > 0).all()
    if method == "afm_physics":
        assert curves["correction/probability"].between(0.2, 1).all()
    assert curves["final/steps"].item() == results.missions["steps"].mean()


def test_hyperparameters_stand_beside_the_measures(make_agent, tmp_path):
    run(make_agent("method=afm_physics", budget=2), curves=Curves(tmp_path / "mine"))
    events = EventAccumulator(str(tmp_path / "mine"))
    events.Reload()
    stored = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    assert b"planner.temperature" in stored and b"corrector." in stored and b"robot" not in stored


def test_curves_go_on_where_a_run_that_was_stopped_goes_on(make_agent, tmp_path):
    def go(stopped=None):
        agent = make_agent("method=physics", budget=12)
        curves = Curves(tmp_path / "mine", every=2)
        run(agent, checkpoint=tmp_path, stopped=stopped, curves=curves)

    with pytest.raises(Stopped):
        go(lambda loop: loop.step == 5)
    assert [*read(tmp_path / "mine")["model/error"].index] == [2, 4]
    go()
    assert [*read(tmp_path / "mine")["model/error"].index] == [2, 4, 6, 8, 10, 12]
