"""Training of the universal flow.

``python -m afm_rl.correction.training.pretrain --out universal.safetensors`` trains it.

``--evaluate`` prints the held-out errors of the weights of the package, by kind of regime and
number of actions, as they stand in the model card; a training ends with the same table.
"""

from __future__ import annotations

import argparse
import hashlib
import time
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor

from afm_rl.correction.achievable import MODES
from afm_rl.correction.experts import Rows, fit_experts
from afm_rl.correction.network import AxisNetwork, load_universal, midpoint
from afm_rl.correction.training.loss import EFFECT_WEIGHT, flow_losses
from afm_rl.correction.training.prior import KINDS, MIXES, Drawn, draw_examples
from afm_rl.storage.files import write_whole

SIZES = {1: 0.12, 2: 0.45, 3: 0.15, 4: 0.08, 6: 0.15, 9: 0.05}  # share of numbers of actions
SHARES = {"mixed": 0.5, "clip": 0.3, "direction": 0.2}  # share of saturation modes
LESIONS = ("across", "experts", "noise")  # parts of the network that can be left out
POOL = 8  # batches that are drawn at once


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
    """Train a network in place on regimes without a robot: Adam, a one-cycle step size.

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
    sizes, shares = torch.tensor(list(SIZES.values())), torch.tensor([SHARES[m] for m in MODES])
    pools: dict[tuple[int, str], list[Drawn]] = {}
    totals, clock = torch.zeros(2), time.perf_counter()
    for step in range(iterations):
        size = list(SIZES)[int(torch.multinomial(sizes, 1, generator=generator))]
        mode = MODES[int(torch.multinomial(shares, 1, generator=generator))]
        pool = pools.setdefault((size, mode), [])
        if not pool:
            many = draw_examples(POOL * batch_size, size, rows, 4, mode, generator)
            for _ in range(reuse):
                order = torch.randperm(POOL * batch_size, generator=generator)
                pool.extend(_take(many, index) for index in order.split(batch_size))
        velocity, effect = (x.mean() for x in flow_losses(network, pool.pop(), mode, generator))
        optimizer.zero_grad(set_to_none=True)
        (velocity + EFFECT_WEIGHT * effect).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        cycle.step()
        totals += torch.stack([velocity.detach(), effect.detach()])
        if step % log == log - 1:
            velocity, effect = (totals / log).tolist()
            spent = time.perf_counter() - clock
            line = f"{step + 1:6d}  velocity {velocity:.4f}  effect {effect:.4f}  {spent:.0f} s"
            print(line, flush=True)
            totals.zero_()


def _take(drawn: Drawn, index: Tensor) -> Drawn:
    rows = Rows(*(part[index] for part in drawn.rows))
    return Drawn(rows, *(part[index] for part in drawn[1:]))


@torch.no_grad()
def evaluate(
    network: AxisNetwork, count: int = 512, seed: int = 1
) -> dict[str, list[tuple[float, float]]]:
    """Return median errors of the action, in half ranges, by kind and number of actions.

    Of the flow, and of doing nothing, each the largest over the axes, for 1, 2, 6 and 17 actions.
    Windows are those of the training: some are nearly empty, some change regime half-way, so no
    error can be zero.
    """
    kinds = {name: ({name: 1.0}, {"none": 1.0}) for name in KINDS}
    kinds |= {name: ({"linear": 1.0}, {name: 1.0}) for name in MIXES if name != "none"}
    table = {}
    for name, shares in kinds.items():
        generator = torch.Generator().manual_seed(seed)
        table[name] = [_error(network, count, size, shares, generator) for size in (1, 2, 6, 17)]
    return table


def _error(network, count, size, shares, generator) -> tuple[float, float]:
    drawn = draw_examples(count, size, max(12, size + 4), 1, "mixed", generator, *shares)
    known = network.encode(drawn.rows, fit_experts(drawn.rows))
    asked = network.ask(known, drawn.planned, "mixed")
    end = midpoint(lambda tau, x: network.velocity(asked, tau, x), drawn.planned, 1)
    both = ((x.clamp(-1, 1) - drawn.intended).abs().amax(-1) for x in (end, drawn.planned))
    flow, nothing = (float(x.median()) for x in both)
    return flow, nothing


def main() -> None:
    """Train, or evaluate."""
    parser = argparse.ArgumentParser(
        prog="python -m afm_rl.correction.training.pretrain", description=__doc__
    )
    parser.add_argument("--out", type=Path, default=Path("universal.safetensors"))
    parser.add_argument("--iterations", type=int, default=40_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--leave-out", choices=LESIONS, help="train without a part, to see its worth"
    )
    parser.add_argument("--evaluate", action="store_true", help="print errors, train nothing")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.evaluate:
        _print_table(load_universal())
        return
    network = AxisNetwork(seed=given.seed, **{part: part != given.leave_out for part in LESIONS})
    pretrain(network, given.iterations, seed=given.seed + 1)
    data = save({name: part.contiguous() for name, part in network.state_dict().items()})
    write_whole(given.out, data)
    checksum = f"{hashlib.sha256(data).hexdigest()}  {given.out.name}\n"
    write_whole(given.out.with_name(given.out.name + ".sha256"), checksum.encode())
    _print_table(network)


def _print_table(network: AxisNetwork) -> None:
    print("| kind | 1 action | 2 | 6 | 17 |\n|---|---|---|---|---|")
    for name, errors in evaluate(network).items():
        cells = (f"{flow:.3f} ({nothing:.3f})" for flow, nothing in errors)
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
