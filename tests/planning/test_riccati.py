"""Riccati sweeps against dense solutions and optimality conditions."""

import math

import pytest
import scipy.linalg
import torch

from afm_rl.planning.riccati import LQProblem, solve_lq, stationary_value

N, S, A = 8, 5, 3


def problem(*batch, bound=math.inf, bounded=range(A), dtype=torch.float64, seed=0):
    """Draw a problem with unstable dynamics, gaps, and boxes of about the size ``bound``."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*batch, *shape, generator=generator, dtype=torch.float64)

    def square(*shape):
        root = draw(*shape, shape[-1])
        return root @ root.mT / shape[-1]

    widths = (bound * (0.1 + draw(N, A).abs()) for _ in range(2))
    free = torch.tensor([i not in bounded for i in range(A)])
    low, high = (width.masked_fill(free, math.inf) for width in widths)
    eye = torch.eye(S).double(), torch.eye(A).double()
    fields = (
        *(eye[0] + 0.3 * draw(N, S, S), draw(N, S, A), 0.3 * draw(N, S)),
        *(square(N + 1, S), draw(N + 1, S), square(N, A) + 0.1 * eye[1], draw(N, A)),
        *(draw(S), -low, high),
    )
    return LQProblem(*(field.to(dtype) for field in fields))


def dense(task):
    """Solve one problem without bounds as a linear system in the stacked controls."""
    reach, offset = [torch.zeros(S, N * A).double()], [task.start]
    for k in range(N):
        step = task.A[k] @ reach[-1]
        step[:, k * A : (k + 1) * A] += task.B[k]
        reach.append(step)
        offset.append(task.A[k] @ offset[-1] + task.c[k])
    hessian, slope = torch.block_diag(*task.R), task.r.flatten().clone()
    for G, x, Q, q in zip(reach, offset, task.Q, task.q, strict=True):
        hessian = hessian + G.T @ Q @ G
        slope += G.T @ (Q @ x + q)
    controls = -torch.linalg.solve(hessian, slope)
    states = torch.stack([G @ controls + x for G, x in zip(reach, offset, strict=True)])
    return states, controls.view(N, A)


def optimality(task, found):
    """Return how far a solution is from each optimality condition."""
    states, controls, _ = found
    moved = torch.einsum("...ij,...j->...i", task.A, states[..., :-1, :])
    moved = moved + torch.einsum("...ij,...j->...i", task.B, controls) + task.c
    costates = [(task.Q[..., -1, :, :] @ states[..., -1, :, None])[..., 0] + task.q[..., -1, :]]
    for k in reversed(range(1, N)):
        own = (task.Q[..., k, :, :] @ states[..., k, :, None])[..., 0] + task.q[..., k, :]
        costates.append(own + (task.A[..., k, :, :].mT @ costates[-1][..., None])[..., 0])
    costate = torch.stack(costates[::-1], -2)
    slope = torch.einsum("...ij,...j->...i", task.R, controls) + task.r
    slope = slope + torch.einsum("...ji,...j->...i", task.B, costate)
    projected = torch.minimum(torch.maximum(controls - slope, task.low), task.high)
    return {
        "dynamics": (moved - states[..., 1:, :]).abs().max(),
        "start": (states[..., 0, :] - task.start).abs().max(),
        "slope": (projected - controls).abs().max(),  # zero at a minimum within a box
    }


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-9), (torch.float32, 2e-3)])
def test_without_bounds_it_equals_a_dense_solution(dtype, atol):
    for seed in range(5):
        states, controls = dense(problem(seed=seed))
        found = solve_lq(problem(seed=seed, dtype=dtype), sweeps=1)
        assert bool(found.exact) and found.states.dtype == dtype
        torch.testing.assert_close(found.states.double(), states, rtol=0, atol=atol)
        torch.testing.assert_close(found.controls.double(), controls, rtol=0, atol=atol)


@pytest.mark.parametrize("bounded", [(), (0,), (0, 1, 2)], ids=str)
@pytest.mark.parametrize("bound", [1e-3, 0.1, 1.0, 100.0])
def test_it_meets_the_optimality_conditions(bound, bounded):
    task = problem(200, bound=bound, bounded=bounded)
    found = solve_lq(task)
    assert found.exact.all()
    for name, error in optimality(task, found).items():
        assert error < 1e-8, name


@pytest.mark.check
def test_sets_that_would_recur_are_left():
    whole_exchanges_cycle = problem(500, bound=0.1, seed=3)
    found = solve_lq(whole_exchanges_cycle)
    assert found.exact.all()
    assert optimality(whole_exchanges_cycle, found)["slope"] < 1e-8


def test_boxes_without_width_fix_the_controls():
    task = problem(4)
    fixed = torch.full_like(task.low, 0.2)
    found = solve_lq(task._replace(low=fixed, high=fixed))
    torch.testing.assert_close(found.controls, fixed)
    assert found.exact.all()


def test_too_few_sweeps_give_a_plan_within_the_bounds_and_say_so():
    tight, loose = problem(2, bound=0.01), problem(2)
    mixed = LQProblem(*(torch.cat(pair) for pair in zip(tight, loose, strict=True)))
    found = solve_lq(mixed, sweeps=1)
    assert found.exact.tolist() == [False, False, True, True]
    errors = optimality(mixed, found)
    assert errors["dynamics"] < 1e-9 and errors["start"] == 0
    assert (found.controls >= mixed.low).all() and (found.controls <= mixed.high).all()
    expected = solve_lq(loose)
    torch.testing.assert_close(found.states[2:], expected.states)


@pytest.mark.parametrize("bound", [0.3, math.inf])
def test_a_problem_that_is_not_convex_or_not_finite_gives_nan_and_hurts_no_other(bound):
    task = problem(4, bound=bound)
    expected = solve_lq(task)
    task.R[1, 3] = -100.0 * torch.eye(A)
    task.A[2, 5] = math.nan
    found = solve_lq(task)
    assert found.controls[1:3].isnan().flatten(1).any(1).all()
    torch.testing.assert_close(found.controls[::3], expected.controls[::3])


def test_the_stationary_value_is_that_of_the_algebraic_riccati_equation():
    move, push = torch.randn(5, 4, 4).double(), torch.randn(5, 4, 2).double()
    weights = torch.eye(4).double(), 0.1 * torch.eye(2).double()
    values, gains = stationary_value(move, push, *weights)
    for a, b, value, gain in zip(move, push, values, gains, strict=True):
        oracle = scipy.linalg.solve_discrete_are(*(each.numpy() for each in (a, b, *weights)))
        torch.testing.assert_close(value, torch.from_numpy(oracle), rtol=1e-8, atol=1e-8)
        assert torch.linalg.eigvals(a - b @ gain).abs().max() < 1
