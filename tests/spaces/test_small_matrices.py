"""Systems of a few equations: written out as they are, and by LAPACK."""

import pytest
import torch

from afm_rl.spaces.small_matrices import eliminate, invert_positive, solve_positive


@pytest.mark.parametrize("size", [1, 2, 3, 5, 7])
@pytest.mark.parametrize("function", [eliminate, solve_positive])
def test_solutions_solve(size, function):
    root = torch.randn(4, 3, size, size, dtype=torch.float64)
    matrix = root @ root.mT + 0.1 * torch.eye(size).double()
    wanted = torch.randn(4, 3, size, 2).double()
    torch.testing.assert_close(function(matrix, matrix @ wanted), wanted, atol=1e-6, rtol=0)
    whole = torch.eye(size).double().expand_as(matrix)
    torch.testing.assert_close(invert_positive(matrix) @ matrix, whole, atol=1e-6, rtol=0)


@pytest.mark.parametrize("size", [2, 7])
def test_what_is_exported_calls_no_lapack(size):
    class Both(torch.nn.Module):
        def forward(self, matrix):
            return invert_positive(matrix) + solve_positive(matrix, matrix)

    matrix = 2 * torch.eye(size).expand(3, -1, -1)
    program = torch.export.export(Both(), (matrix,))
    assert not [n for n in program.graph.nodes if "linalg" in str(n.target)]
    torch.testing.assert_close(program.module()(matrix), torch.eye(size).expand(3, -1, -1) * 1.5)


@pytest.mark.parametrize(("size", "written_out"), [(3, True), (6, True), (9, True), (30, False)])
def test_what_is_singular_but_for_rounding_is_inverted(size, written_out):
    """As where commands stand still at their bounds, and are as constant as the 1."""
    constant = 1 + 1e-4 * torch.rand(200, size, 80, generator=torch.Generator().manual_seed(0))
    matrix = constant @ constant.mT + 1e-6 * torch.eye(size)
    assert torch.linalg.cholesky_ex(matrix).info.any()
    inverse, unit = invert_positive(matrix), torch.eye(size).expand_as(matrix)
    assert inverse.isfinite().all() and (inverse.diagonal(dim1=-2, dim2=-1) > 0).all()
    if written_out:
        assert eliminate(matrix, unit).isfinite().all()
