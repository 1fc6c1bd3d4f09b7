"""Fitting the newest network of a KNODE to rows of a flight."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from afm_rl.dynamics.body_frame import to_world
from afm_rl.dynamics.knode import KNODE
from afm_rl.dynamics.residual import Network
from afm_rl.spaces.manifold import wrap_angle

Triple = tuple[Tensor, Tensor, Tensor]  # states, actions, next states


def fit_network(
    model: KNODE,
    network: Network,
    rows: Triple,
    counts: Tensor,
    dt: float,
    *,
    epochs: int,
    lr: float,
    l2: float,
    exact: bool = False,
) -> Network:
    r"""Return the network as it is best pushed: full-batch Adam on the one-step loss.

    .. math:: \tfrac12\,\mathrm{mean}\,\|x^+ - \hat x^+\|^2 + \lambda \|\theta\|^2

    The half is the published one, where the mean also counts the first, equal column. Missions
    are independent. Fast: the prediction is that of the model without the network, plus its
    output at the start of the row, held and propagated to first order in the network:
    :math:`h (I + \tfrac{h A}{2} + \tfrac{(h A)^2}{6}) N`, A the derivative of the rate by the
    state. Exact: one Runge-Kutta step with the network.

    Args:
        model: whose pool the network will join, as the newest; stays as it is.
        network: the start, ``(l, in, hidden)`` and so on, l missions.
        rows: states ``(*L, n, S)``, actions and next states, with l = prod(L).
        counts: which rows count, ``(*L, n)`` boolean; the others must be finite.
        dt: length of a row, h (s).
        epochs: steps of Adam.
        lr: their size.
        l2: :math:`\lambda`.
        exact: whether to differentiate through the integration.

    >>> from afm_rl.dynamics import Quadrotor
    >>> model = KNODE(Quadrotor())
    >>> state = torch.zeros(75, 13).index_fill(1, torch.tensor(9), 1.0)
    >>> action = torch.tensor([0.2943, 0.0, 0.0, 0.0]).expand(75, 4)
    >>> pushed = model.advance(state, action, 0.002)
    >>> pushed[:, 5] += 0.002 * 9.81  # the thrust does more than it should
    >>> start = model.draw(torch.randn(1, model.numbers))
    >>> settings = {"epochs": 80, "lr": 0.01, "l2": 5e-8}
    >>> rows, counts = (state, action, pushed), torch.ones(75, dtype=torch.bool)
    >>> found = fit_network(model, start, rows, counts, 0.002, **settings)
    >>> after = model.push_(Network(*(part[0] for part in found))).advance(state, action, 0.002)
    >>> bool((after - pushed).abs().max() < 0.002)
    True
    """
    shapes = [part.shape[1:] for part in network]
    sizes = [shape.numel() for shape in shapes]
    flat = nn.Parameter(torch.cat([part.detach().flatten(1) for part in network], 1))
    optimizer = torch.optim.Adam([flat], lr=lr, fused=True)
    state, action, after = (part.detach() for part in rows)
    counted = counts.reshape(len(flat), -1, 1).to(flat)
    share = counted / (state.shape[-1] * counted.sum(1, keepdim=True).clamp_min(1.0))
    gradient = (_exact if exact else _fast)(model, (state, action, after), share, dt)

    def unpacked() -> Network:
        parts = flat.detach().split(sizes, 1)
        return Network(*(p.unflatten(1, s) for p, s in zip(parts, shapes, strict=True)))

    for _ in range(epochs):
        slopes = torch.cat([part.flatten(1) for part in gradient(unpacked())], 1)
        flat.grad = slopes.add_(flat.detach(), alpha=2 * l2)
        optimizer.step()
    return Network(*(part.clone() for part in unpacked()))


Gradient = Callable[[Network], Sequence[Tensor]]


def _exact(model: KNODE, rows: Triple, share: Tensor, dt: float) -> Gradient:
    """Return the gradient of the data term as a function of the network."""
    state, action, after = rows
    lead = model.lead

    def gradient(network: Network) -> Sequence[Tensor]:
        with torch.enable_grad():
            leaves = [part.requires_grad_() for part in network]
            newest = Network(*(part.reshape(*lead, *part.shape[1:]) for part in leaves))
            ahead = model.advance(state, action, dt, newest=newest)
            error = _difference(model, ahead, after).square().reshape(*share.shape[:2], -1)
            return torch.autograd.grad((share * error).sum() / 2, leaves)

    return gradient


@torch.no_grad()
def _fast(model: KNODE, rows: Triple, share: Tensor, dt: float) -> Gradient:
    """Do so to first order in the network's output, in closed form."""
    state, action, after = rows
    none = Network(*(torch.zeros_like(part[..., 0, :, :]) for part in model.networks))
    gap = _difference(model, after, model.advance(state, action, dt, newest=none))
    size = model.state_size
    eye = torch.eye(size, dtype=gap.dtype, device=gap.device)
    moved = dt * model.slope(state, action, none)[..., :size]
    reach = dt * (eye + moved @ (eye + moved / 3) / 2)
    if model.turned:
        reach = reach @ to_world(state)
    inputs = torch.cat([state[..., model.features], action], -1)
    rows_of = share.shape[:2]
    inputs, gap = (part.reshape(*rows_of, -1) for part in (inputs, gap))
    reach = reach.reshape(*rows_of, size, size)
    # The error is quadratic in the output y: its gradient is share * (R' R y - R' gap).
    square, pull = share.unsqueeze(-1) * (reach.mT @ reach), share * _times(reach.mT, gap)

    def gradient(network: Network) -> Sequence[Tensor]:
        units = torch.baddbmm(network.inner_bias, inputs, network.inner).tanh()
        output = torch.baddbmm(network.outer_bias, units, network.outer)
        by_output = _times(square, output) - pull
        by_inner = (by_output @ network.outer.mT) * (1 - units.square())
        return (
            inputs.mT @ by_inner,
            by_inner.sum(1, keepdim=True),
            units.mT @ by_output,
            by_output.sum(1, keepdim=True),
        )

    return gradient


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def _difference(model: KNODE, state: Tensor, origin: Tensor) -> Tensor:
    """Subtract coordinates, angles by the shorter way, rotations as numbers."""
    gap = state - origin
    return torch.where(model.manifold.is_angle, wrap_angle(gap), gap)
