"""Linear models, against the solutions of least squares."""

import math

import numpy as np
import pytest
import torch

from afm_rl.correction.healthy import rate_limit, sensor_noise, stiction
from afm_rl.correction.hypotheses import HYPOTHESES
from afm_rl.correction.least_squares import invert_affine
from afm_rl.correction.linear import Evidence, trend

FITS = {row.name: row.fit for row in HYPOTHESES if row.fit is not None}


def evidence_of(sent, came, weight=None, noise=0.02):
    """Return rows ``(1, M, A)`` as evidence."""
    weight = torch.ones_like(sent) if weight is None else weight.expand_as(sent)
    rows = [x.mT.double() for x in (sent, sent, came, weight)]
    return Evidence(*rows, torch.full_like(rows[0][..., 0], noise))


def fits_of(evidence, *names):
    """Return all fits of lines and maps, or those with these names, one of each."""
    names = names or FITS
    fits = {name: FITS[name](evidence) for name in names}
    return {name: type(fit)(*(x.unsqueeze(1) for x in fit)) for name, fit in fits.items()}


def solved(columns, effects):
    return np.linalg.lstsq(np.stack(columns, -1), effects, rcond=None)[0]


def test_every_fit_is_the_least_squares_solution_of_its_rows():
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 20)
    v = 0.3 - 0.8 * u + 0.05 * rng.normal(size=20)
    sent, came = (torch.tensor(x, dtype=torch.float32).view(1, 20, 1) for x in (u, v))
    line = solved([u, np.ones(20)], v)
    wanted = {
        "reversed": (-1.0, 0.0),
        "gain": (solved([u], v)[0], 0.0),
        "line": line,
        "affine": line,
        "swapped": (1.0, 0.0),  # one axis has no other
    }
    assert {*wanted, "trend"} == set(FITS)
    fits = fits_of(evidence_of(sent, came))
    for name, (gain, offset) in wanted.items():
        ends = fits[name].effect(torch.tensor([0.0, 1.0], dtype=torch.float64).view(1, 1, 2, 1))
        zero, one = ends.flatten().tolist()
        assert zero == pytest.approx(offset, abs=0.01), name
        assert one - zero == pytest.approx(gain, abs=0.01), name
        planned = fits[name].effect(torch.full((1, 1, 1, 1), 0.4, dtype=torch.float64))
        answer = fits[name].invert(planned[:, 0, 0])
        assert float(answer) == pytest.approx(0.4, abs=0.01), name


def leverage_of(x, *columns):
    """Return the variance of the prediction at x by least squares with these columns."""
    columns = np.stack(columns, -1)
    return np.asarray(x) @ np.linalg.inv(columns.T @ columns) @ np.asarray(x)


def test_the_variance_of_every_fit_is_that_of_its_prediction():
    rng, at = np.random.default_rng(0), 0.7
    u, w, v = rng.uniform(-1, 1, (3, 40))
    sent, came = (
        torch.tensor(np.stack(x, -1), dtype=torch.float32)[None] for x in ([u, w], [v, u])
    )
    action, one = torch.tensor([[[at, 0.4]]], dtype=torch.float64), np.ones(40)
    fits = fits_of(evidence_of(sent, came))
    variance = {name: fit.variance(action)[0, 0, 0] for name, fit in fits.items()}
    wanted = {
        "reversed": 0.0,
        "gain": leverage_of([at], u),
        "line": leverage_of([at, 1], u, one),
        "trend": 5.0,
        "affine": leverage_of([at, 0.4, 1], u, w, one),
        "swapped": 0.0,
    }
    for name, value in wanted.items():
        assert float(variance[name][0]) == pytest.approx(value, rel=0.02), name


@pytest.mark.parametrize("period", [6.0, 20.0, math.inf])
def test_a_disturbance_goes_on_as_it_changes(period):
    """It oscillates, or is a line, whatever the commands are."""
    time = torch.arange(31.0)
    oscillation = 0.3 * (2 * math.pi * time / period).sin()
    disturbance = 0.1 + 0.01 * time if period == math.inf else oscillation
    u = torch.rand(1, 30, 1, generator=torch.Generator().manual_seed(0))
    came, weight = u + disturbance[:30].view(1, 30, 1), torch.ones(1, 30, 1)
    weight[:, 10:14] = 0.0  # these are not known
    came[:, 10:14] = 7.0

    def goes_on(came, weight):
        gain, offset, _ = trend(evidence_of(u, came, weight))
        assert gain == 1.0
        return float(offset)

    assert goes_on(came, weight) == pytest.approx(float(disturbance[-1]), abs=0.01)
    weight[:, -2] = 0.0
    assert goes_on(came, weight) == pytest.approx(float(disturbance[-2]))
    assert goes_on(came, 0 * weight) == 0.0
    assert goes_on(-u, weight + 1) >= -0.5  # more would be a fault


def test_a_rate_is_known_from_two_effects_in_a_row():
    came = torch.tensor([[[0.0], [0.2], [0.3]]])

    def ends(valid):
        rows = evidence_of(torch.zeros(1, 3, 1), came, torch.tensor(valid).view(1, 3, 1))
        return [float(rate_limit(rows, torch.full((1, 1), end))) for end in (-9.0, 9.0)]

    assert ends([1.0, 1.0, 1.0]) == pytest.approx([0.1, 0.5])
    assert ends([1.0, 0.0, 1.0]) == ends([1.0, 1.0, 0.0]) == [-9.0, 9.0]


def test_errors_of_readings_are_smoothed_exponentially():
    missed, valid = torch.tensor([0.3, -0.1, 0.2]), torch.tensor([1.0, 0.0, 1.0])
    rows = evidence_of(torch.zeros(1, 3, 1), missed.view(1, 3, 1), valid.view(1, 3, 1))
    expected = 0.4 - (0.7**3 * 0.3 + 0.7 * 0.2)
    assert float(sensor_noise(rows, torch.full((1, 1), 0.4))) == pytest.approx(expected)


@pytest.mark.parametrize(("command", "effect"), [(0.35, 0.2), (0.42, 0.42), (0.05, 0.2)])
def test_what_sticks_rests_within_the_band_in_which_it_rested(command, effect):
    """It rests at .2 while commands are up to .2 away from that."""
    sent = torch.tensor([0.2, 0.3, 0.4]).view(1, 3, 1)
    rows = evidence_of(sent, torch.full_like(sent, 0.2))
    assert float(stiction(rows, torch.full((1, 1), command))) == pytest.approx(effect)


def test_singular_maps_have_answers_of_moderate_size():
    almost = torch.tensor([[1.0, 1.0], [1.0, 1.0 + 1e-6]])
    action = invert_affine(almost, torch.zeros(2, 1), torch.tensor([[1.0], [-1.0]]))
    assert action.abs().max() < 1


def test_swapped_are_the_two_that_do_what_the_other_one_is_commanded():
    """From two rows; an axis that does as commanded, and one whose partner does, has no other."""
    u = torch.tensor([[[0.3, -0.2, 0.1, 0.5], [0.1, 0.4, -0.3, 0.2]]])

    def matrix_of(order):
        return fits_of(evidence_of(u, u[..., order]), "swapped")["swapped"].matrix[0, 0].float()

    for order in ([2, 1, 0, 3], [0, 1, 2, 3], [3, 2, 1, 0]):
        torch.testing.assert_close(matrix_of(order), torch.eye(4)[order])
    around = matrix_of([1, 2, 0, 3])  # three of them in a ring are no pairs
    torch.testing.assert_close(around, around.mT)
