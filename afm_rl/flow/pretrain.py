"""Training of the universal flow: ``python -m afm_rl.flow.pretrain``."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
from torch import Tensor

from afm_rl.flow.network import AxisNetwork
from afm_rl.flow.prior import Drawn, draw_examples
from afm_rl.flow.saturation import MODES
from afm_rl.flow.training import EFFECT_WEIGHT, flow_losses

SIZES = {1: 0.12, 2: 0.45, 3: 0.15, 4: 0.08, 6: 0.15, 9: 0.05}  # share of numbers of actions
SHARES = {"mixed": 0.5, "clip": 0.3, "direction": 0.2}  # share of saturation modes
PLANS = 4  # per window


def pretrain(
    network: AxisNetwork,
    iterations: int,
    batch_size: int = 160,
    rows: int = 12,
    lr: float = 3e-3,
    reuse: int = 4,
    seed: int = 0,
    log: int = 500,
) -> None:
    """Train a network in place, with Adam and a one-cycle step size.

    Args:
        network: the universal network.
        iterations: gradient steps.
        batch_size: windows per step, each with four plans.
        rows: of a window.
        lr: largest step size.
        reuse: how often a window is used.
        seed: of everything drawn.
        log: steps between two printed lines.
    """
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(network.parameters(), lr=lr, fused=True)
    cycle = torch.optim.lr_scheduler.OneCycleLR(optimizer, lr, total_steps=iterations)
    sizes = torch.tensor(list(SIZES.values()))
    shares = torch.tensor([SHARES[mode] for mode in MODES])
    pools: dict[tuple[int, str], list[Drawn]] = {}
    totals, clock = torch.zeros(2), time.perf_counter()
    for step in range(iterations):
        size = list(SIZES)[int(torch.multinomial(sizes, 1, generator=generator))]
        mode = MODES[int(torch.multinomial(shares, 1, generator=generator))]
        pool = pools.setdefault((size, mode), [])
        if not pool:
            many = draw_examples(8 * batch_size, size, rows, PLANS, mode, generator)
            for _ in range(reuse):
                order = torch.randperm(8 * batch_size, generator=generator).split(batch_size)
                pool.extend(_take(many, index) for index in order)
        velocity, effect = (
            part.mean() for part in flow_losses(network, pool.pop(), mode, generator)
        )
        optimizer.zero_grad(set_to_none=True)
        (velocity + EFFECT_WEIGHT * effect).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        cycle.step()
        totals += torch.stack([velocity.detach(), effect.detach()])
        if step % log == log - 1:
            spent = time.perf_counter() - clock
            print(
                f"{step + 1:6d}  velocity {totals[0] / log:.4f}  effect {totals[1] / log:.4f}  "
                f"{spent:.0f} s",
                flush=True,
            )
            totals.zero_()


def _take(drawn: Drawn, index: Tensor) -> Drawn:
    rows = type(drawn.rows)(*(part[index] for part in drawn.rows))
    return Drawn(rows, *(part[index] for part in drawn[1:]))


def main() -> None:
    """Train and write the weights."""
    from safetensors.torch import save_file

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("universal.safetensors"))
    parser.add_argument("--iterations", type=int, default=40_000)
    parser.add_argument("--batch-size", type=int, default=160)
    parser.add_argument("--width", type=int, default=128)
    parser.add_argument("--latent", type=int, default=64)
    parser.add_argument("--lr", type=float, default=3e-3)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    network = AxisNetwork(width=arguments.width, latent=arguments.latent, seed=arguments.seed)
    pretrain(
        network,
        arguments.iterations,
        arguments.batch_size,
        lr=arguments.lr,
        seed=arguments.seed + 1,
    )
    save_file({k: v.contiguous() for k, v in network.state_dict().items()}, arguments.out)


if __name__ == "__main__":
    main()
