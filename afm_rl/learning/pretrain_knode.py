"""Training of a KNODE's first network before any flight."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.compiling.devices import device_of
from afm_rl.dynamics import DynamicsModel, Oracle
from afm_rl.dynamics.knode import KNODE
from afm_rl.errors import ConfigurationError, check_count, check_number
from afm_rl.progress import Bar
from afm_rl.regimes import Regime
from afm_rl.spaces.manifold import uniform


def pretrain_knode(
    model: KNODE,
    teacher: DynamicsModel,
    state_box: tuple[Tensor, Tensor],
    action_box: tuple[Tensor, Tensor],
    *,
    regime: Regime | None = None,
    flights: int = 64,
    ticks: int = 16,
    epochs: int = 200,
    lr: float = 0.01,
    noise: float = 1e-4,
    seed: int = 0,
    progress: bool = False,
) -> float:
    """Fit a new network of a KNODE to short flights of a teacher; return its held-out error.

    Each flight starts from a state in its box and takes a new action from its box at every tick.
    States are seen with noise. Full-batch Adam on the squared error of a tick in units of
    the model's own noise, through the integration. The published offline data are not public:
    this recipe is not theirs.

    Args:
        model: KNODE to teach, in place: the network is pushed first.
        teacher: model that flies.
        state_box: lowest and highest first state, ``(S,)`` each.
        action_box: lowest and highest action, ``(A,)`` each.
        regime: every flight is under a regime of its own from this prior; nominal if None.
        flights: number of flights; a tenth as many more are held out.
        ticks: their length.
        epochs: steps of Adam.
        lr: their size.
        noise: standard deviation of what is added to states on the tangent space.
        seed: seed of data and network.
        progress: show progress.

    Returns:
        Root mean square of the held-out one-tick error, in units of the model's own noise.

    Raises:
        ConfigurationError: for a setting out of range, or a model whose missions already learn.

    >>> from afm_rl.dynamics import Quadrotor
    >>> level = torch.zeros(13).index_fill(0, torch.tensor(9), 1.0)
    >>> actions = torch.tensor([0.2, 0, 0, 0]), torch.tensor([0.4, 0, 0, 0])
    >>> boxes, data = ((level, level + 0.1), actions), {"flights": 4, "ticks": 2, "epochs": 2}
    >>> error = pretrain_knode(KNODE(Quadrotor()), Quadrotor(), *boxes, **data)
    >>> 0 < error < 100
    True
    """
    if model.lead:
        raise ConfigurationError(
            f"dynamics: train the model before it is given to {model.lead[0]} missions"
        )
    check_count("dynamics.pretrain.flights", flights)
    check_count("dynamics.pretrain.ticks", ticks)
    check_count("dynamics.pretrain.epochs", epochs)
    check_number("dynamics.pretrain.lr", lr, low=0.0, open_low=True)
    check_number("dynamics.pretrain.noise", noise, low=0.0)
    check_count("dynamics.pretrain.seed", seed, low=0)
    generator, device = torch.Generator().manual_seed(seed), device_of(model)
    space, total = model.manifold, flights + -(-flights // 10)
    low, high, lowest, highest = (end.to(device) for end in (*state_box, *action_box))
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
