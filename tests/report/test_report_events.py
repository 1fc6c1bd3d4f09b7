"""TensorBoard reads what was written."""

import numpy as np
import pandas as pd
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from afm_rl.report import write_events
from afm_rl.report.write import FILE


def read(folder):
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    return {
        tag: pd.Series({event.step: event.value for event in events.Scalars(tag)})
        for tag in events.Tags()["scalars"]
    }


def test_a_method_has_its_curves_and_its_result(tmp_path, make_results, laps):
    missions, steps = make_results()
    written = write_events(tmp_path, missions, steps, laps)
    assert written == [tmp_path / name / FILE for name in ("physics", "adaptive", "oracle")]
    curves = read(tmp_path / "adaptive")
    assert set(curves) == {
        *("came_true/miss", "came_true/unforeseen", "model/error", "model/loss"),
        *("step/misaligned", "step/regime_active", "step/reached"),
        *("final/success_rate", "final/steps"),
    }
    own = steps[steps["mission"] == 1]
    for tag, curve in curves.items():
        if not tag.startswith("final"):
            np.testing.assert_allclose(curve, own[tag.split("/")[1]], rtol=1e-6)
    assert min(curves) == "came_true/miss"  # TensorBoard's order
    assert curves["final/steps"].to_dict() == {0: 119}
    assert curves["final/success_rate"].to_dict() == {0: 1.0}


def test_a_mean_is_taken_over_those_still_running(tmp_path, make_results, laps):
    missions, steps = make_results(["oracle"], seeds=3)
    steps = steps[(steps["mission"] != 2) | (steps["t"] < 40)]
    write_events(tmp_path, missions, steps, laps)
    error = read(tmp_path / "oracle")["model/error"]
    rows = steps.pivot(index="t", columns="mission", values="error")
    np.testing.assert_allclose(error, rows.mean(axis=1), rtol=1e-6)
    assert rows[2].isna().any()


def test_long_curves_are_means_over_a_few_steps(tmp_path, make_results, laps):
    missions, steps = make_results(["physics"])
    many = pd.concat([steps.assign(t=steps["t"] + 400 * k) for k in range(6)])
    write_events(tmp_path, missions, many, laps)
    error = read(tmp_path / "physics")["model/error"]
    assert len(error) == 480
    np.testing.assert_allclose(error.loc[5], many["error"].iloc[5:10].mean(), rtol=1e-6)
