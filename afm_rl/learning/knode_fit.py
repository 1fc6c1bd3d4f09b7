"""Fitting the newest network of a KNODE to rows of a flight."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from afm_rl.dynamics.body_frame import to_world
from afm_rl.dynamics.knode import KNODE
from afm_rl.dynamics.residual import Network, residual
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
    are independent. Exact: :math:`\hat x^+` is one Runge-Kutta step with the network. Fast: it is
    that of the model without the network, plus its output at the start of the row, held and
    propagated to first order, :func:`first_order`.

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
    learnt = Network(*(nn.Parameter(part.detach().clone()) for part in network))
    # Weight decay of Adam is the gradient of the second term.
    optimizer = torch.optim.Adam(learnt, lr=lr, weight_decay=2 * l2, fused=True)
    counted = counts.reshape(len(learnt.inner), -1, 1).to(learnt.inner)
    share = counted / (model.state_size * counted.sum(1, keepdim=True).clamp_min(1.0))
    errors = (through_integration if exact else first_order)(model, rows, dt)
    with torch.enable_grad():
        for _ in range(epochs):
            optimizer.zero_grad(set_to_none=True)
            error = errors(learnt).reshape(*share.shape[:2], -1)
            ((share * error.square()).sum() / 2).backward()
            optimizer.step()
    return Network(*(part.detach() for part in learnt))


def through_integration(model: KNODE, rows: Triple, dt: float) -> Callable[[Network], Tensor]:
    """Return the errors of rows ``(*L, n, S)`` as a function of the newest network."""
    state, action, after = rows

    def errors(network: Network) -> Tensor:
        newest = Network(*(part.reshape(*model.lead, *part.shape[1:]) for part in network))
        return _difference(model, model.advance(state, action, dt, newest=newest), after)

    return errors


@torch.no_grad()
def first_order(model: KNODE, rows: Triple, dt: float) -> Callable[[Network], Tensor]:
    r"""Return them ``(l, n, S)`` to first order in the network's output N.

    .. math:: \hat x^+ = x_0^+ + h (I + \tfrac{h A}{2} + \tfrac{(h A)^2}{6}) N

    with :math:`x_0^+` the prediction without it, and A the derivative of the rate by the state.
    """
    state, action, after = rows
    none = Network(*(torch.zeros_like(part[..., 0, :, :]) for part in model.networks))
    gap = _difference(model, after, model.advance(state, action, dt, newest=none))
    moved = dt * model.slope(state, action, none)
    eye = torch.eye(model.state_size, dtype=gap.dtype, device=gap.device)
    reach = dt * (eye + moved @ (eye + moved / 3) / 2)
    if model.turned:
        reach = reach @ to_world(state)
    inputs = torch.cat([state[..., model.features], action], -1)
    missions = model.lead.numel()
    inputs, gap = (part.reshape(missions, -1, part.shape[-1]) for part in (inputs, gap))
    reach = reach.reshape(*gap.shape, -1)

    def errors(network: Network) -> Tensor:
        return (reach @ residual(inputs, network).unsqueeze(-1)).squeeze(-1) - gap

    return errors


def _difference(model: KNODE, state: Tensor, origin: Tensor) -> Tensor:
    """Subtract coordinates, angles by the shorter way, rotations as numbers."""
    gap = state - origin
    return torch.where(model.manifold.is_angle, wrap_angle(gap), gap)
