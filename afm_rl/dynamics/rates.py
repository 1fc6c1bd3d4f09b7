"""Rates of change: their derivatives, and their integration over time."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.autograd import forward_ad

from afm_rl.spaces.manifold import Manifold, wrap_angle

ONE_AT_A_TIME = threading.RLock()  # the level of dual numbers is that of the process


def derivative(
    function: Callable[..., Tensor], inputs: Sequence[Tensor], tangents: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """Return a function's value, and its derivative along the ``tangents`` of its ``inputs``.

    What ``torch.func.jvp`` returns, in a third of its time for small tensors, and from any thread.

    >>> derivative(torch.square, [torch.tensor(3.0)], [torch.tensor(1.0)])
    (tensor(9.), tensor(6.))
    """
    inputs = tuple(part.contiguous() for part in inputs)
    tangents = tuple(part.contiguous() for part in tangents)
    if torch.compiler.is_compiling():
        found = torch.func.jvp(function, inputs, tangents)
        return found[0], found[1]
    with ONE_AT_A_TIME, forward_ad.dual_level():
        duals = [forward_ad.make_dual(*pair) for pair in zip(inputs, tangents, strict=True)]
        value, slope = forward_ad.unpack_dual(function(*duals))
    return value, torch.zeros_like(value) if slope is None else slope


def pushed_forward(
    function: Callable[[Tensor], Tensor], point: Tensor, slope: Tensor
) -> tuple[Tensor, Tensor]:
    """Return a function's value ``(*B, R)`` at a ``point`` ``(*B, S)``, and its derivative.

    That is by K parameters, ``(*B, R, K)``, given the point's by them, ``slope`` ``(*B, S, K)``.

    >>> pushed_forward(torch.square, torch.tensor([3.0]), torch.tensor([[1.0, 2.0]]))
    (tensor([9.]), tensor([[ 6., 12.]]))
    """
    columns = slope.mT
    value, moved = derivative(function, (point.unsqueeze(-2).expand_as(columns),), (columns,))
    return value[..., 0, :], moved.mT


def linearised(
    function: Callable[[Tensor, Tensor], Tensor], state: Tensor, action: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return a function of state ``(*B, S)`` and action ``(*B, A)``, and its derivatives by both.

    Forward differentiation of all S + A columns in one batch; ``(*B, R)``, ``(*B, R, S)``,
    ``(*B, R, A)``.

    >>> value, by_state, by_action = linearised(torch.mul, torch.ones(2), torch.tensor([3.0, 4.0]))
    >>> by_state.tolist(), by_action.tolist()
    ([[3.0, 0.0], [0.0, 4.0]], [[1.0, 0.0], [0.0, 1.0]])
    """
    sizes = (state.shape[-1], action.shape[-1])
    axes = torch.eye(sum(sizes), device=state.device, dtype=state.dtype)
    inputs, tangents = [], []
    for given, axis in zip((state, action), axes.split(sizes, -1), strict=True):
        wide = given.unsqueeze(-2).expand(*given.shape[:-1], *axis.shape)
        inputs.append(wide)
        tangents.append(axis.to(wide).expand_as(wide))
    value, columns = derivative(function, inputs, tangents)
    by_state, by_action = columns.mT.split(sizes, -1)
    return value[..., 0, :], by_state, by_action


class HeldRate(ABC):
    """The rate of change :math:`x' = f(x, u)` while an action u is held."""

    @abstractmethod
    def __call__(self, state: Tensor) -> Tensor:
        """Return the rate of change ``(*B, S)``."""

    @abstractmethod
    def tangent(self, state: Tensor, through: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rate ``(*B, S)`` and its derivative ``(*B, S, K)``, by actions last.

        ``through`` ``(*B, S, K)`` is that of the state.
        """

    @abstractmethod
    def finish(self, state: Tensor) -> Tensor:
        """Put integrated states ``(*B, S)`` back into the state space."""


class HeldFunction(HeldRate):
    """Any function ``(state, action) -> rate`` as a rate; derivatives by forward differentiation.

    >>> held = HeldFunction(torch.ones(1), lambda x, u: torch.cat([x[..., 1:], u], -1), Manifold(2))
    >>> held.tangent(torch.zeros(2), torch.eye(2, 3))[1]
    tensor([[0., 1., 0.],
            [0., 0., 1.]])
    """

    def __init__(
        self, action: Tensor, function: Callable[[Tensor, Tensor], Tensor], manifold: Manifold
    ) -> None:
        self.action, self.function, self.manifold = action, function, manifold

    def __call__(self, state: Tensor) -> Tensor:
        return self.function(state, self.action)

    def tangent(self, state: Tensor, through: Tensor) -> tuple[Tensor, Tensor]:
        size, actions = through.shape[-1], self.action.shape[-1]
        wide = [
            given.unsqueeze(-2).expand(*given.shape[:-1], size, -1)
            for given in (state, self.action)
        ]
        drive = torch.eye(size, dtype=state.dtype, device=state.device)[:, size - actions :]
        value, slope = derivative(self.function, wide, (through.mT, drive.expand_as(wide[1])))
        return value[..., 0, :], slope.mT

    def finish(self, state: Tensor) -> Tensor:
        return torch.where(self.manifold.is_angle, wrap_angle(state), state)


def runge_kutta(
    rate: Callable[[Tensor], Tensor], state: Tensor, dt: float, substeps: int
) -> Tensor:
    """Return the last state ``(*B, S)`` of :func:`runge_kutta_path`.

    >>> runge_kutta(torch.neg, torch.ones(1), 1.0, 4)  # exp(-1) = 0.36788
    tensor([0.3679])
    """
    return runge_kutta_path(rate, state, dt, substeps)[-1]


def runge_kutta_path(
    rate: Callable[[Tensor], Tensor], state: Tensor, dt: float, substeps: int
) -> list[Tensor]:
    """Integrate :math:`x' = f(x)` for ``dt`` s; return the states ``(*B, S)`` after each step."""
    step, path = dt / substeps, []
    for _ in range(substeps):
        first = rate(state)
        second = rate(torch.add(state, first, alpha=step / 2))
        third = rate(torch.add(state, second, alpha=step / 2))
        fourth = rate(torch.add(state, third, alpha=step))
        slope = torch.add(first + fourth, second + third, alpha=2.0)
        state = torch.add(state, slope, alpha=step / 6)
        path.append(state)
    return path


def runge_kutta_linearised(
    rate: HeldRate, state: Tensor, actions: int, dt: float, substeps: int
) -> tuple[Tensor, Tensor, Tensor]:
    r"""Integrate :math:`x' = f(x, u)` together with the derivatives of x by its start and u.

    The chain rule through the stages:
    :math:`dk_i = \tfrac{\partial f}{\partial x}(x_i)\,dx_i + \tfrac{\partial f}{\partial u}(x_i)`.
    Returns the state ``(*B, S)``, put back into the state space, and its derivatives ``(*B, S, S)``
    and ``(*B, S, A)``.

    >>> from afm_rl.dynamics.rates import HeldFunction
    >>> from afm_rl.spaces.manifold import Manifold
    >>> decay = HeldFunction(torch.zeros(1), lambda x, u: u - x, Manifold(1))
    >>> [part.item() for part in runge_kutta_linearised(decay, torch.ones(1), 1, 1.0, 4)]
    [0.3678..., 0.3678..., 0.6321...]
    """
    size, step = state.shape[-1], dt / substeps
    eye = torch.eye(size, size + actions, dtype=state.dtype, device=state.device)
    through = eye.expand(*state.shape[:-1], *eye.shape)
    for _ in range(substeps):
        total, slope = torch.zeros_like(state), torch.zeros_like(through)
        here, there = state, through
        for weight, reach in ((1, 0.5), (2, 0.5), (2, 1.0), (1, 0.0)):
            change, turn = rate.tangent(here, there)
            total = torch.add(total, change, alpha=weight)
            slope = torch.add(slope, turn, alpha=weight)
            if reach:
                here = torch.add(state, change, alpha=reach * step)
                there = torch.add(through, turn, alpha=reach * step)
        state = torch.add(state, total, alpha=step / 6)
        through = torch.add(through, slope, alpha=step / 6)
    state, through = pushed_forward(rate.finish, state, through)
    return state, through[..., :size], through[..., size:]
