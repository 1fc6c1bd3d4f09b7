"""The reference solver: what it needs, and what it does with bad problems."""

import math
import sys

import pytest
import torch

from afm_rl.errors import ConfigurationError
from afm_rl.planning import conic
from afm_rl.planning.conic import load_casadi, solve_conic
from afm_rl.planning.riccati import LQProblem


def problem():
    one = torch.ones(1, 1)
    return LQProblem(
        *(one[None], one[None], torch.zeros(1, 1), one.expand(2, 1, 1), torch.zeros(2, 1)),
        *(one[None], torch.zeros(1, 1), torch.tensor([4.0]), -one, one),
    )


def test_without_casadi_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(ConfigurationError, match=r"install afm-rl\[mpc\]"):
        load_casadi()


def test_a_single_problem_in_single_precision():
    pytest.importorskip("casadi")
    found = solve_conic(problem())
    torch.testing.assert_close(found.controls, torch.tensor([[-1.0]]))
    torch.testing.assert_close(found.states, torch.tensor([[4.0], [3.0]]))
    assert found.exact.shape == () and bool(found.exact)


@pytest.mark.parametrize("start", [math.nan, math.inf])
def test_a_problem_that_is_not_finite_gives_nan(start):
    pytest.importorskip("casadi")
    found = solve_conic(problem()._replace(start=torch.tensor([start])))
    assert found.controls.isnan().all() and not bool(found.exact)


def test_a_problem_that_it_cannot_solve_gives_nan(monkeypatch):
    pytest.importorskip("casadi")
    conic._solver.cache_clear()
    monkeypatch.setitem(conic.OPTIONS, "iter_max", 1)
    found = solve_conic(problem())
    conic._solver.cache_clear()
    assert found.controls.isnan().all() and not bool(found.exact)
