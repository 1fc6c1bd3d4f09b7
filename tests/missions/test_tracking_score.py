"""What flights are judged by, step by step."""

import math

import pytest
import torch
from tensordict import TensorDict

from afm_rl.missions import TrackingScore

PHASES = [0] * 3 + [1] * 6 + [2] * 3
SINCE = [0] * 3 + [3] * 6 + [9] * 3


def flown(heights, lost=False, hold=0.2):
    """Let one flight end its steps at the given errors of the height; return its row."""
    score = TrackingScore(dt=0.1, band=0.02, hold=hold)
    missions = TensorDict({"mission": {"parameters": torch.zeros(2, 3, 1)}}, [2])
    sums, ids = score.start(missions), torch.tensor([1])
    sums["steps"] = torch.zeros(2)
    for step, height in enumerate(heights):
        pose = torch.zeros(1, 13)
        pose[:, 2] = 1.0 + height
        after = {
            "square_error": torch.tensor([[1.0, 2.0, 3.0 * step]]),
            "pose": pose,
            "reference": torch.tensor([0, 0, 1.0, 0, 0, 0]).expand(1, 5, 6),
            "lost": torch.tensor([lost]),
        }
        now = {"phase": PHASES[step], "since": SINCE[step], "step": step}
        now = {name: torch.tensor([value]) for name, value in now.items()}
        score.add(sums, ids, TensorDict({**now, "next": TensorDict(after, [1])}, [1]))
    table = score.table(None, missions, sums)
    return {name: column[1].item() for name, column in table.items()}


def test_errors_are_means_over_steps_and_axes():
    row = flown([0.0] * 12)
    assert row["mse"] == pytest.approx((1 + 2 + 3 * 5.5) / 3)
    assert row["mse_z"] == pytest.approx(3 * 5.5)
    assert row["mse_phase_0"] == pytest.approx((1 + 2 + 3 * 1) / 3)
    assert row["mse_phase_1"] == pytest.approx((1 + 2 + 3 * 5.5) / 3)
    assert row["mse_phase_2"] == pytest.approx((1 + 2 + 3 * 10) / 3)


def test_phases_that_never_came_have_no_numbers():
    row = flown([0.0] * 5)
    assert math.isnan(row["mse_phase_2"]) and math.isnan(row["settle_2"])
    assert row["mse"] == pytest.approx(3.0)


def test_the_peak_is_the_largest_error_of_either_sign():
    assert flown([0.1, -0.4, 0.3])["peak_z"] == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("errors", "time"),
    [
        ([0.0, 0.0, 1.0], 0.0),  # the change has come to nothing
        ([0.1, 0.0, 0.01, 0.0], 0.1),
        ([0.1, -0.1, 0.0, 0.05, -0.01, 0.019], 0.4),  # one step is not enough
        ([0.1, 0.1, 0.1, 0.1, 0.1, 0.0], math.nan),  # and not across the next change
    ],
)
def test_a_flight_has_settled_once_it_stays_in_the_band(errors, time):
    row = flown([0.0] * 3 + errors + [0.0] * (9 - 3 - len(errors)) + [0.1] * 3)
    assert row["settle_1"] == pytest.approx(time, nan_ok=True)
    assert math.isnan(row["settle_2"])


def test_a_flight_may_be_asked_to_stay_for_one_step_only():
    assert flown([0.0] * 3 + [0.1, 0.1, 0.0], hold=0.0)["settle_1"] == pytest.approx(0.2)


def test_a_lost_flight_is_not_finished():
    assert flown([0.0], lost=False)["finished"] and not flown([0.0], lost=True)["finished"]
