"""The linear-quadratic problems of :mod:`afm_rl.planning.riccati` through casadi."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest
import torch

from afm_rl.planning.riccati import LQProblem, LQSolution

casadi = pytest.importorskip("casadi")

OPTIONS = {
    **{"iter_max": 100, "res_g_max": 1e-7, "res_b_max": 1e-7, "res_d_max": 1e-7},
    "res_m_max": 1e-11,  # complementarity: decides how well active bounds are met
    **{"lam_min": 1e-20, "t_min": 1e-20},  # with their default floors it stays above 1e-8
}


def solve_conic(problem: LQProblem) -> LQSolution:
    """Solve by HPIPM, an interior-point method for optimal control, one problem at a time.

    A reference for :func:`~afm_rl.planning.riccati.solve_lq`: it computes in float64 on the
    CPU, and gives NaN where HPIPM does not converge.

    Args:
        problem: what to solve.
    """
    batch, inputs = problem.start.shape[:-1], problem.r.shape[-1]
    stages, size = problem.c.shape[-2:]
    solver = _solver(stages, size, inputs)
    wide = stages * (size + inputs) + size
    fields = [
        x.detach().reshape(-1, *x.shape[len(batch) :]).double().cpu().numpy() for x in problem
    ]
    found = np.full((len(fields[0]), wide), np.nan)
    for row, values in zip(found, zip(*fields, strict=True), strict=True):
        if all(np.isfinite(value).all() for value in values[:8]):  # bounds may be infinite
            answer = solver(**_data(LQProblem(*values)))
            if solver.stats()["success"]:
                row[:] = np.asarray(answer["x"]).ravel()
    out = torch.as_tensor(found).to(problem.start)
    body = out[:, :-size].reshape(-1, stages, size + inputs)
    states = torch.cat([body[..., :size], out[:, None, -size:]], 1)
    return LQSolution(
        states.reshape(*batch, stages + 1, size),
        body[..., size:].reshape(*batch, stages, inputs),
        out[:, 0].isfinite().reshape(batch),
    )


@lru_cache
def _solver(stages: int, size: int, inputs: int) -> Any:
    """Return a solver for variables (x_0, u_0, x_1, ..., x_N), all blocks dense."""
    blocks = [np.ones((n, n)) for _ in range(stages) for n in (size, inputs)]
    weight = casadi.diagcat(*map(casadi.DM, [*blocks, np.ones((size, size))]))
    move = np.zeros((stages * size, weight.shape[0]))
    for k in range(stages):
        row, column = k * size, k * (size + inputs)
        move[row : row + size, column : column + size + inputs] = 1.0
        move[row : row + size, column + size + inputs :][:, :size] = np.eye(size)
    return casadi.conic(
        "stages",
        "hpipm",
        {"h": weight.sparsity(), "a": casadi.sparsify(casadi.DM(move)).sparsity()},
        {
            **{"N": stages, "nx": [size] * (stages + 1), "nu": [inputs] * stages + [0]},
            **{"ng": [0] * (stages + 1), "error_on_fail": False, "print_time": False},
            "hpipm": OPTIONS,
        },
    )


def _data(problem: Any) -> dict[str, Any]:
    """Return one problem of arrays as what the solver takes."""
    stages, size = problem.c.shape
    inputs = problem.r.shape[-1]
    pairs = [problem.Q[:-1], problem.R]
    weight = casadi.diagcat(
        *[casadi.DM(block) for pair in zip(*pairs, strict=True) for block in pair],
        casadi.DM(problem.Q[-1]),
    )
    linear = np.append(np.hstack([problem.q[:-1], problem.r]), problem.q[-1])
    free = np.full((stages, size), np.inf)
    low = np.append(np.hstack([-free, problem.low]), -free[0])
    high = np.append(np.hstack([free, problem.high]), free[0])
    low[:size] = high[:size] = problem.start
    move = np.zeros((stages * size, len(linear)))
    for k in range(stages):
        row, column = k * size, k * (size + inputs)
        move[row : row + size, column : column + size] = problem.A[k]
        move[row : row + size, column + size : column + size + inputs] = problem.B[k]
        move[row : row + size, column + size + inputs :][:, :size] = -np.eye(size)
    level = -problem.c.ravel()
    return {"h": weight, "g": linear, "a": move, "lba": level, "uba": level,
            "lbx": low, "ubx": high}  # fmt: skip
