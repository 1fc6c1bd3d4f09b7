"""Fitting the newest network of a KNODE: to rows of a flight, or before any flight."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import torch
from annotated_types import Le
from torch import Tensor, nn

from afm_rl.compiling.devices import device_of
from afm_rl.dynamics import DynamicsModel, Oracle
from afm_rl.dynamics.knode import KNODE
from afm_rl.dynamics.residual import Network, residual, to_world
from afm_rl.errors import ConfigurationError
from afm_rl.options import Count, Natural, NonNegative, Positive, options
from afm_rl.progress import Bar
from afm_rl.regimes import Regime
from afm_rl.spaces.manifold import uniform

Triple = tuple[Tensor, Tensor, Tensor]  # states, actions, next states
DECAY = 5e-8  # lambda, weight of the squared parameters


def fit_network(
    model: KNODE,
    network: Network,
    rows: Triple,
    counts: Tensor,
    dt: float,
    *,
    epochs: int,
    lr: float,
) -> Network:
    r"""Return the network as it is best pushed: full-batch Adam on the one-step loss.

    .. math:: \tfrac12\,\mathrm{mean}\,\|x^+ - \hat x^+\|^2 + \lambda \|\theta\|^2

    The half is the published one, where the mean also counts the first, equal column. Missions
    are independent. :math:`\hat x^+` is to first order in the network, :func:`first_order`: six
    times as fast as gradients through the integration.

    Args:
        model: whose pool the network will join, as the newest; stays as it is.
        network: the start, ``(l, in, hidden)`` and so on, l missions.
        rows: states ``(*L, n, S)``, actions and next states, with l = prod(L).
        counts: which rows count, ``(*L, n)`` boolean; the others must be finite.
        dt: length of a row, h (s).
        epochs, lr: see :class:`~afm_rl.learning.KNODEUpdater`.

    >>> from afm_rl.dynamics import Quadrotor
    >>> model = KNODE(Quadrotor())
    >>> state = torch.zeros(75, 13).index_fill(1, torch.tensor(9), 1.0)
    >>> action = torch.tensor([0.2943, 0.0, 0.0, 0.0]).expand(75, 4)
    >>> pushed = model.advance(state, action, 0.002)
    >>> pushed[:, 5] += 0.002 * 9.81  # the thrust does more than it should
    >>> start = model.draw(torch.randn(1, model.numbers))
    >>> settings = {"epochs": 80, "lr": 0.01}
    >>> rows, counts = (state, action, pushed), torch.ones(75, dtype=torch.bool)
    >>> found = fit_network(model, start, rows, counts, 0.002, **settings)
    >>> after = model.push_(Network(*(part[0] for part in found))).advance(state, action, 0.002)
    >>> bool((after - pushed).abs().max() < 0.002)
    True
    """
    learnt = Network(*(nn.Parameter(part.detach().clone()) for part in network))
    # Weight decay of Adam is the gradient of the second term.
    optimizer = torch.optim.Adam(learnt, lr=lr, weight_decay=2 * DECAY, fused=True)
    counted = counts.reshape(len(learnt.inner), -1, 1).to(learnt.inner)
    share = counted / (model.state_size * counted.sum(1, keepdim=True).clamp_min(1.0))
    errors = first_order(model, rows, dt)
    with torch.enable_grad():
        for _ in range(epochs):
            optimizer.zero_grad(set_to_none=True)
            ((share * errors(learnt).square()).sum() / 2).backward()
            optimizer.step()
    return Network(*(part.detach() for part in learnt))


@torch.no_grad()
def first_order(model: KNODE, rows: Triple, dt: float) -> Callable[[Network], Tensor]:
    r"""Return the errors of rows ``(l, n, S)`` as a function of the newest network.

    Its output N at the start of a row is held and propagated to first order,

    .. math:: \hat x^+ = x_0^+ + h (I + \tfrac{h A}{2} + \tfrac{(h A)^2}{6}) N

    with :math:`x_0^+` the prediction without it, and A the derivative of the rate by the state.
    """
    state, action, after = rows
    none = Network(*(torch.zeros_like(part[..., 0, :, :]) for part in model.networks))
    gap = model.manifold.subtract(after, model.advance(state, action, dt, newest=none))
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


@options("dynamics.pretrain")
def pretrain_knode(
    model: KNODE,
    teacher: DynamicsModel,
    state_bounds: tuple[Tensor, Tensor],
    action_bounds: tuple[Tensor, Tensor],
    *,
    regime: Regime | None = None,
    flights: Annotated[
        Count, Le(100_000_000), "flights for training; a tenth more are held out"
    ] = 64,
    ticks: Annotated[Count, Le(100_000_000), "length of each flight, ticks"] = 16,
    epochs: Annotated[Count, Le(100_000_000), "full-batch steps of Adam"] = 200,
    lr: Annotated[Positive, Le(1), "step size"] = 0.01,
    noise: Annotated[NonNegative, "noise of states, m, m/s, rad, rad/s"] = 1e-4,
    seed: Annotated[Natural, "seed of data and network"] = 0,
    progress: bool = False,
) -> float:
    """Fit a new network of a KNODE to short flights of a teacher; return its held-out error.

    Each flight starts from a random state and takes a new random action at every tick, both within
    their bounds. Measured states have noise. Full-batch Adam minimises the squared error of a tick,
    in units of the model's noise, through the integration. The offline data of the authors are not
    public, so this recipe differs from theirs.

    Args:
        model: KNODE to teach, in place: the network is pushed first.
        teacher: model that flies.
        state_bounds: lowest and highest first state, ``(S,)`` each.
        action_bounds: lowest and highest action, ``(A,)`` each.
        regime: prior from which every flight draws its own regime; nominal if None.
        progress: show progress.

    Returns:
        Root mean square of the held-out one-tick error, in units of the model's own noise.

    Raises:
        ConfigurationError: for a setting out of range, or a model whose missions already learn.

    >>> from afm_rl.dynamics import Quadrotor
    >>> level = torch.zeros(13).index_fill(0, torch.tensor(9), 1.0)
    >>> actions = torch.tensor([0.2, 0, 0, 0]), torch.tensor([0.4, 0, 0, 0])
    >>> bounds, data = ((level, level + 0.1), actions), {"flights": 4, "ticks": 2, "epochs": 2}
    >>> error = pretrain_knode(KNODE(Quadrotor()), Quadrotor(), *bounds, **data)
    >>> 0 < error < 100
    True
    """
    if model.lead:
        raise ConfigurationError(
            f"dynamics: train the model before you expand it to {model.lead[0]} missions"
        )
    generator, device = torch.Generator().manual_seed(seed), device_of(model)
    space, total = model.manifold, flights + -(-flights // 10)
    low, high, lowest, highest = (end.to(device) for end in (*state_bounds, *action_bounds))
    state = space.project(uniform(low, high, total, generator))
    if regime is not None:
        teacher = Oracle(teacher, regime)
        teacher.set_regime(regime.sample((total,), generator).to(device))
    path = [state]
    actions = uniform(lowest, highest, ticks * total, generator).split(total)
    with torch.no_grad():
        for action in actions:
            path.append(teacher(path[-1], action))
        seen = torch.stack(path)
        shaken = torch.randn(*seen.shape[:2], space.tangent_size, generator=generator)
        seen = space.add(seen, noise * shaken.to(seen))
    numbers = torch.randn(model.numbers, generator=generator)
    model.push_(model.draw(numbers.to(device)))
    held = torch.stack(actions)

    def miss(part: slice) -> Tensor:
        ahead = model(seen[:-1, part], held[:, part])
        return model.standardise(space.difference(seen[1:, part], ahead)).square().mean()

    optimizer = torch.optim.Adam(model.parameters(), lr=lr, fused=True)
    with torch.enable_grad():
        bar = Bar(range(epochs), desc="pre-training the KNODE", shown=progress)
        for _ in bar:
            optimizer.zero_grad(set_to_none=True)
            miss(slice(flights)).backward()
            optimizer.step()
    with torch.no_grad():
        return float(miss(slice(flights, None)).sqrt())
