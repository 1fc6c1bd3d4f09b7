"""Linear models, against the solutions of least squares."""

import math

import numpy as np
import pytest
import torch

from afm_rl.correction.hypotheses import HYPOTHESES
from afm_rl.correction.linear import LinearModels, invert_affine, sensor_noise, within_rate

LINEAR = [row.name for row in HYPOTHESES if row.kind == "linear"]
fit_lines = LinearModels([row.fit for row in HYPOTHESES if row.fit is not None])
DRIVEN, AFFINE = LINEAR.index("driven"), LINEAR.index("affine")


def fitted(regime, rows, size=6, noise=0.0):
    """Fit all models to some rows of a regime; return the matrices, ``(L, A, A)``."""
    generator = torch.Generator().manual_seed(0)
    sent = 2 * torch.rand(1, rows, size, generator=generator) - 1
    came = regime(sent) + noise * torch.randn(sent.shape, generator=generator)
    return fit_lines(sent, sent, came, torch.ones(sent.shape)).matrix[0]


def swapped(sent):
    return torch.cat([sent[..., 1:2], -0.5 * sent[..., :1], 0.7 * sent[..., 2:]], -1)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_swapped_cables_are_found_in_few_rows(noise):
    matrix = fitted(swapped, rows=5, noise=noise)
    expected = torch.zeros(2, 6)
    expected[0, 1], expected[1, 0] = 1.0, -0.5
    torch.testing.assert_close(matrix[DRIVEN, :2], expected, rtol=0, atol=0.03)
    assert (matrix[AFFINE, :2] - expected).abs().max() > 0.1  # five rows are too few for this one


def test_an_axis_that_its_own_command_drives_is_left_to_the_affine_map():
    matrix = fitted(swapped, rows=5)
    assert torch.equal(matrix[DRIVEN, 2:], matrix[AFFINE, 2:])


def test_what_no_single_command_explains_is_left_to_the_affine_map():
    turned = fitted(lambda sent: sent @ torch.tensor([[0.6, 0.8], [-0.8, 0.6]]), rows=9, size=2)
    assert torch.equal(turned[DRIVEN], turned[AFFINE])


def test_of_three_rows_nothing_is_said_to_be_swapped():
    matrix = fitted(swapped, rows=3)
    assert torch.equal(matrix[DRIVEN], matrix[AFFINE])


def test_an_axis_is_driven_by_its_own_command_if_that_explains_it():
    generator = torch.Generator().manual_seed(0)
    sent = 2 * torch.rand(1, 9, 1, generator=generator).expand(1, 9, 2) - 1
    came = sent.clone()
    sent = sent + torch.tensor([0.0, 0.015]) * torch.randn(1, 9, 2, generator=generator)
    lines = fit_lines(sent, sent, came, torch.ones(1, 9, 2))  # the first fits the second, by chance
    assert torch.equal(lines.matrix[0, DRIVEN], lines.matrix[0, AFFINE])


def solved(columns, effects):
    return np.linalg.lstsq(np.stack(columns, -1), effects, rcond=None)[0]


def test_every_line_is_the_least_squares_solution_of_its_rows():
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 20)
    v = 0.3 - 0.8 * u + 0.05 * rng.normal(size=20)
    sent, came = (torch.tensor(x, dtype=torch.float32).view(1, 20, 1) for x in (u, v))
    lines = fit_lines(sent, sent, came, torch.ones(1, 20, 1))
    matrix, bias = lines.matrix, lines.bias
    found = {row: (matrix[0, k, 0, 0], bias[0, k, 0]) for k, row in enumerate(LINEAR)}
    one = np.ones(20)
    gain_12 = solved([u[-12:]], v[-12:])[0]
    b, c, a, d = solved([u[1:], u[:-1], v[:-1], one[1:]], v[1:])
    wanted = {
        "reversed": (-1.0, 0.0),
        "offset_1": (1.0, (v - u)[-1]),
        "offset_3": (1.0, (v - u)[-3:].mean()),
        "gain_3": (solved([u[-3:]], v[-3:])[0], 0.0),
        "gain": (solved([u], v)[0], 0.0),
        "line_12": solved([u[-12:], one[-12:]], v[-12:]),
        "line": solved([u, one], v),
        "drift": (gain_12, v[-1] - gain_12 * u[-1]),
        "arx": (b, c * u[-1] + a * v[-1] + d),
        "affine": solved([u, one], v),
        "swapped": (1.0, 0.0),  # one axis has no other
    }
    assert {*wanted, "trend", "driven"} == set(LINEAR)
    for name, (gain, offset) in wanted.items():
        assert float(found[name][0]) == pytest.approx(gain, abs=0.03), name
        assert float(found[name][1]) == pytest.approx(offset, abs=0.03), name


def leverage_of(x, *columns):
    """Return the variance of the prediction at x by least squares with these columns."""
    columns = np.stack(columns, -1)
    return np.asarray(x) @ np.linalg.inv(columns.T @ columns) @ np.asarray(x)


def test_the_variance_of_every_line_is_that_of_its_prediction():
    rng, at = np.random.default_rng(0), 0.7
    u, w, v = rng.uniform(-1, 1, (3, 40))
    sent, came = (
        torch.tensor(np.stack(x, -1), dtype=torch.float32)[None] for x in ([u, w], [v, u])
    )
    lines = fit_lines(sent, sent, came, torch.ones(1, 40, 2))
    variance = lines.variance(torch.tensor([[[at, 0.4]]]))[0, :, 0]
    one = np.ones(40)
    wanted = {
        "reversed": 0.0,
        "offset_1": 1.0,
        "offset_3": 1 / 3,
        "gain_3": leverage_of([at], u[-3:]),
        "gain": leverage_of([at], u),
        "line_12": leverage_of([at, 1], u[-12:], one[-12:]),
        "line": leverage_of([at, 1], u, one),
        "drift": leverage_of([at], u[-12:]) + 1,
        "arx": leverage_of([at, u[-1], v[-1], 1], u[1:], u[:-1], v[:-1], one[1:]),
        "trend": 5.0,
        "affine": leverage_of([at, 0.4, 1], u, w, one),
        "swapped": 0.0,
    }
    for name, value in wanted.items():
        assert float(variance[LINEAR.index(name), 0]) == pytest.approx(value, rel=0.02), name
    driven = variance[LINEAR.index("driven"), 1]  # by the first command
    assert float(driven) == pytest.approx(leverage_of([at], u), rel=0.01)


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
    trend = LINEAR.index("trend")
    lines = fit_lines(u, u, came, weight)
    assert lines.matrix[0, trend] == 1.0
    assert float(lines.bias[0, trend]) == pytest.approx(float(disturbance[-1]), abs=0.01)
    weight[:, -2] = 0.0
    newest = fit_lines(u, u, came, weight).bias[0, trend]
    assert float(newest) == pytest.approx(float(disturbance[-2]))
    assert fit_lines(u, u, came, 0 * weight).bias[0, trend] == 0.0
    assert fit_lines(u, u, -u, weight + 1).bias[0, trend] >= -0.5  # more would be a fault


def test_what_goes_on_is_learned_from_rows_that_follow_each_other():
    """The robot is pushed at row 7, which is not to be believed; nor is what came after it."""
    u = 2 * torch.rand(1, 15, 1, generator=torch.Generator().manual_seed(0)) - 1
    v = u.clone()
    for k in range(1, 15):
        v[:, k] = u[:, k] + 0.5 * v[:, k - 1]
    v[:, 7] = 30.0
    weight = torch.ones(1, 15, 1)
    weight[:, 7] = 0.0
    matrix, bias, *_ = fit_lines(u, u, v, weight)
    arx = LINEAR.index("arx")
    assert float(matrix[0, arx]) == pytest.approx(1.0, abs=0.01)
    assert float(bias[0, arx]) == pytest.approx(0.5 * float(v[0, -1]), abs=0.02)


def test_a_rate_is_known_from_two_effects_in_a_row():
    came = torch.tensor([[[0.0], [0.2], [0.3]]])
    limited = within_rate(came, torch.ones(1, 3, 1)).flatten()
    torch.testing.assert_close(limited, torch.tensor([0.1, 0.5]))
    for valid in ([1.0, 0.0, 1.0], [1.0, 1.0, 0.0]):
        free = within_rate(came, torch.tensor(valid).view(1, 3, 1))
        assert free.flatten().tolist() == [-math.inf, math.inf]


def test_errors_of_readings_are_smoothed_exponentially():
    missed = torch.tensor([0.3, -0.1, 0.2])
    valid = torch.tensor([1.0, 0.0, 1.0]).view(1, 3, 1)
    found = sensor_noise(torch.zeros(1, 3, 1), missed.view(1, 3, 1), valid, keep=0.7)
    assert float(found) == pytest.approx(-(0.7**3 * 0.3 + 0.7 * 0.2))


def test_singular_maps_have_answers_of_moderate_size():
    almost = torch.tensor([[1.0, 1.0], [1.0, 1.0 + 1e-6]])
    action = invert_affine(almost, torch.zeros(2, 1), torch.tensor([[1.0], [-1.0]]))
    assert action.abs().max() < 1


def test_swapped_are_the_two_that_do_what_the_other_one_is_commanded():
    """From two rows; an axis that does as commanded, and one whose partner does, has no other."""
    u = torch.tensor([[[0.3, -0.2, 0.1, 0.5], [0.1, 0.4, -0.3, 0.2]]])
    swapped = LINEAR.index("swapped")
    for order in ([2, 1, 0, 3], [0, 1, 2, 3], [3, 2, 1, 0]):
        matrix = fit_lines(u, u, u[..., order], torch.ones(1, 2, 4)).matrix[0, swapped]
        torch.testing.assert_close(matrix, torch.eye(4)[order])
    around = u[..., [1, 2, 0, 3]]  # three of them in a ring are no pairs
    matrix = fit_lines(u, u, around, torch.ones(1, 2, 4)).matrix[0, swapped]
    torch.testing.assert_close(matrix, matrix.mT)
