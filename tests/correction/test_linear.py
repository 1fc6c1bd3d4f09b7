"""Linear models that mix axes."""

import pytest
import torch

from afm_rl.correction.hypotheses import HYPOTHESES
from afm_rl.correction.linear import fit_lines

LINEAR = [row.name for row in HYPOTHESES if row.kind == "linear"]
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
