"""Linear-quadratic optimal control with boxes on the controls, by Riccati sweeps."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class LQProblem(NamedTuple):
    r"""A linear-quadratic problem over N stages, in deviations from a trajectory.

    .. math::
        \min \sum_{k=0}^{N} \tfrac12 x_k^\top Q_k x_k + q_k^\top x_k
           + \sum_{k=0}^{N-1} \tfrac12 u_k^\top R_k u_k + r_k^\top u_k
        \quad\text{s.t.}\quad x_{k+1} = A_k x_k + B_k u_k + c_k,\ x_0 \text{ given},\
        l_k \le u_k \le h_k

    Q and R are symmetric, Q positive semi-definite, R positive definite.
    """

    A: Tensor
    """``(*B, N, S, S)``"""
    B: Tensor
    """``(*B, N, S, A)``"""
    c: Tensor
    """``(*B, N, S)``"""
    Q: Tensor
    """``(*B, N + 1, S, S)``"""
    q: Tensor
    """``(*B, N + 1, S)``"""
    R: Tensor
    """``(*B, N, A, A)``"""
    r: Tensor
    """``(*B, N, A)``"""
    start: Tensor
    """x_0, ``(*B, S)``"""
    low: Tensor
    """``(*B, N, A)``; minus infinity where there is no bound"""
    high: Tensor
    """``(*B, N, A)``; infinity where there is no bound"""


class LQSolution(NamedTuple):
    """States and controls that solve an :class:`LQProblem`."""

    states: Tensor
    """``(*B, N + 1, S)``"""
    controls: Tensor
    """``(*B, N, A)``"""
    exact: Tensor
    """``(*B)`` boolean: is this the minimum, or merely within the bounds?"""


def solve_lq(problem: LQProblem, sweeps: int = 300, patience: float = 3.0) -> LQSolution:
    r"""Solve linear-quadratic problems, all of a batch at once.

    A primal-dual active-set method: a Riccati sweep solves the problem in which some control
    components are held at a bound and the others are free; then each free component that
    left its bounds is held, and each held one whose gradient
    :math:`R_k u_k + r_k + B_k^\top p_{k+1}` (p: the costate) points inwards is let go, until
    neither happens. Where it stops this way the solution is exact to rounding: it satisfies
    the optimality conditions of a convex problem. One sweep does where no bound is active.
    So that sets cannot recur, components change sides one at a time, the last first, while
    their number does not shrink for ``patience`` sweeps (Judice and Pires 1994).

    After ``sweeps`` sets the controls are clamped and ``exact`` is false. Problems whose
    reduced Hessian is not positive definite, or that are not finite, give NaN.

    >>> one = torch.ones(1, 1)
    >>> problem = LQProblem(  # one stage: move a point to 0, at a price
    ...     A=one[None], B=one[None], c=torch.zeros(1, 1), Q=one.expand(2, 1, 1),
    ...     q=torch.zeros(2, 1), R=one[None], r=torch.zeros(1, 1), start=torch.tensor([4.0]),
    ...     low=-one, high=one)
    >>> solve_lq(problem).controls, solve_lq(problem._replace(low=-9 * one)).controls.round()
    (tensor([[-1.]]), tensor([[-2.]]))
    """
    batch = problem.start.shape[:-1]
    flat = _flatten(problem)
    tiny = 256 * torch.finfo(flat.r.dtype).eps
    low, high = flat.low - tiny * flat.low.abs(), flat.high + tiny * flat.high.abs()
    at_low = at_high = torch.zeros_like(flat.r, dtype=torch.bool)
    fewest = torch.full_like(flat.start[:, 0], torch.inf)
    credit = torch.full_like(fewest, patience)
    for _ in range(sweeps):
        held = at_low | at_high
        at = torch.where(at_low, flat.low, torch.where(at_high, flat.high, 0.0))
        states, controls, gradient = _sweep(flat, held, at)
        now_low = torch.where(held, at_low & (gradient >= -tiny), controls < low)
        now_high = torch.where(held, at_high & (gradient <= tiny), controls > high)
        wrong = (now_low != at_low) | (now_high != at_high)
        count = wrong.sum((0, 2)).to(fewest)
        if not bool(count.any()):
            break
        credit = torch.where(count < fewest, patience, credit - 1.0)
        fewest = torch.minimum(count, fewest)
        wrong = torch.where((credit < 0.0).unsqueeze(-1), _last(wrong), wrong)
        at_low, at_high = torch.where(wrong, now_low, at_low), torch.where(wrong, now_high, at_high)
    else:
        clamped = torch.minimum(torch.maximum(controls, flat.low), flat.high)
        controls = torch.where(count.bool().unsqueeze(-1), clamped, controls)
        states = _roll(flat, controls)
    return LQSolution(
        states.transpose(0, 1).reshape(*batch, *problem.q.shape[-2:]),
        controls.transpose(0, 1).reshape(*batch, *problem.r.shape[-2:]),
        (count == 0).reshape(batch),
    )


def stationary_value(
    A: Tensor, B: Tensor, Q: Tensor, R: Tensor, doublings: int = 20
) -> tuple[Tensor, Tensor]:
    r"""Return P ``(*B, S, S)`` and K ``(*B, A, S)`` of the stationary linear-quadratic regulator.

    .. math:: \sum_{k=0}^\infty x_k^\top Q x_k + u_k^\top R u_k = x_0^\top P x_0
        \quad\text{for}\quad u_k = -K x_k,\ x_{k+1} = A x_k + B u_k

    Each round of the structure-preserving doubling algorithm (Chu et al. 2004) doubles the number
    of stages that P looks ahead. In double precision, returned in that of A. All may have batch
    dimensions: A ``(*B, S, S)``, B ``(*B, S, A)``, Q ``(*B, S, S)``, R ``(*B, A, A)``.

    >>> one = torch.ones(1, 1)
    >>> stationary_value(one, one, one, one)  # the golden ratio, and its inverse
    (tensor([[1.6180]]), tensor([[0.6180]]))
    """
    dtype, eye = A.dtype, torch.eye(A.shape[-1], device=A.device).double()
    A, B, Q, R = (x.double() for x in (A, B, Q, R))
    move, value = A, Q.expand_as(A)
    reach = B @ torch.linalg.solve(R, B.mT)
    for _ in range(doublings):
        both = torch.linalg.solve_ex(eye + reach @ value, torch.cat([move, reach], -1)).result
        onward, pull = both.split(A.shape[-1], -1)
        change = move.mT @ value @ onward
        value, reach, move = value + change, reach + move @ pull @ move.mT, move @ onward
        if bool(change.abs().amax() <= 1e-12 * value.abs().amax()):
            break
    gain = torch.linalg.solve_ex(R + B.mT @ value @ B, B.mT @ value @ A).result
    return value.to(dtype), gain.to(dtype)


def _last(wrong: Tensor) -> Tensor:
    """Keep the last true entry of ``(N, b, A)`` for each b."""
    stages, flights, inputs = wrong.shape
    row = wrong.transpose(0, 1).flatten(1)
    place = row.shape[1] - 1 - row.flip(1).byte().argmax(1, keepdim=True)
    only = torch.zeros_like(row).scatter_(1, place, True)
    return only.view(flights, stages, inputs).transpose(0, 1)


def _flatten(problem: LQProblem) -> LQProblem:
    """Turn ``(*B, N, ...)`` into ``(N, b, ...)``: stages first, as the sweeps take them."""
    dims = problem.start.dim() - 1
    staged = problem._asdict()
    start = staged.pop("start")
    return LQProblem(
        start=start.reshape(-1, start.shape[-1]),
        **{name: x.reshape(-1, *x.shape[dims:]).transpose(0, 1) for name, x in staged.items()},
    )


def _sweep(flat: LQProblem, held: Tensor, at: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Solve with the components ``held`` ``(N, b, A)`` at the values ``at``, the others free.

    Returns states ``(N + 1, b, S)``, controls ``(N, b, A)`` and the gradient of the objective
    in the controls ``(N, b, A)``, as a fraction of its terms.

    States carry a constant 1, z = (x, 1), so that one symmetric matrix per stage holds the
    whole quadratic: H = W + M' P M, where z' = M (z, u). Held components become constants of
    the dynamics; a dummy of unit weight, which stays zero, takes their place.
    """
    free = (~held).to(flat.r)
    size, n, value = flat.start.shape[-1], flat.start.shape[-1] + 1, at.unsqueeze(-1)
    moved = (flat.c.unsqueeze(-1) + flat.B @ value).squeeze(-1)
    pull = (flat.r + (flat.R @ value).squeeze(-1)) * free
    total = n + free.shape[-1]
    move = free.new_zeros(*free.shape[:2], n, total)
    move[..., :size, :size], move[..., :size, size] = flat.A, moved
    move[..., size, size], move[..., :size, n:] = 1.0, flat.B * free.unsqueeze(-2)
    weight = free.new_zeros(*free.shape[:2], total, total)
    weight[..., :size, :size] = flat.Q[:-1]
    weight[..., :size, size] = weight[..., size, :size] = flat.q[:-1]
    weight[..., n:, size] = weight[..., size, n:] = pull
    weight[..., n:, n:] = flat.R * free.unsqueeze(-1) * free.unsqueeze(-2)
    weight.diagonal(dim1=-2, dim2=-1)[..., n:] += 1.0 - free
    later = free.new_zeros(free.shape[1], n, n)
    later[:, :size, :size] = flat.Q[-1]
    later[:, :size, size] = later[:, size, :size] = flat.q[-1]

    laters, roots, halves, faults = [], [], [], []
    for step, cost in zip(reversed(move.unbind(0)), reversed(weight.unbind(0)), strict=True):
        laters.append(later)
        hessian = torch.baddbmm(cost, step.mT, torch.bmm(later, step))
        root, fault = torch.linalg.cholesky_ex(hessian[:, n:, n:])
        half = torch.linalg.solve_triangular(root, hessian[:, n:, :n], upper=False)
        later = torch.baddbmm(hessian[:, :n, :n], half.mT, half, alpha=-1.0)
        roots.append(root)
        halves.append(half)
        faults.append(fault)
    root, half = torch.stack(roots[::-1]), torch.stack(halves[::-1])
    gain = -torch.linalg.solve_triangular(root.mT, half, upper=True)
    fault = torch.stack(faults[::-1])[..., None, None]
    gain = torch.where(fault > 0, torch.nan, gain)

    path = [torch.cat([flat.start, torch.ones_like(flat.start[:, :1])], -1).unsqueeze(-1)]
    for closed in (move[..., :n] + move[..., n:] @ gain).unbind(0):
        path.append(torch.bmm(closed, path[-1]))
    wide = torch.stack(path)
    controls = at.unsqueeze(-1) + gain @ wide[:-1]
    costate = torch.stack(laters[::-1])[..., :size, :] @ wide[1:]
    cost_gradient, passed = flat.R @ controls + flat.r.unsqueeze(-1), flat.B.mT @ costate
    terms = (cost_gradient.abs() + passed.abs()).clamp_min(torch.finfo(cost_gradient.dtype).tiny)
    return wide[..., :size, 0], controls.squeeze(-1), ((cost_gradient + passed) / terms).squeeze(-1)


def _roll(flat: LQProblem, controls: Tensor) -> Tensor:
    """Return the states ``(N + 1, b, S)`` that the controls ``(N, b, A)`` lead to."""
    pushes = (flat.B @ controls.unsqueeze(-1)).squeeze(-1) + flat.c
    path = [flat.start]
    for step, push in zip(flat.A, pushes, strict=True):
        path.append((step @ path[-1].unsqueeze(-1)).squeeze(-1) + push)
    return torch.stack(path)
