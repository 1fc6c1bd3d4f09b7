"""An exported graph beside torch: size, equality, closed loop and time.

    python benchmarks/bench_onnx.py

A robot with two actions, under every family of actuator regimes: healthy for a tenth of the ticks,
then a new regime of the family in every fifth of them. At each tick both get torch's memory. An
answer that differs by more than 1e-4 of the largest action was chosen among actions that are as
good, up to rounding. In closed loop each has its own memory. Times are processor times of one
thread; their limits are meant for a core that has nothing else to do.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from bench_export import HIGH, LOW, controller
from torch import Tensor

from afm_rl.dynamics import Dubins
from afm_rl.regimes import Compose, actuator_regimes, shifted
from afm_rl.transforms.controller import Controller, export_controller

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "deploy"))
from agent import graph  # noqa: E402

SIZE, EQUAL, TIES = 2e6, 1e-4, 0.001  # bytes; share of the largest action; share of the ticks
SILENT, CORRECTING = 0.15, 0.8  # ms
ALONE = "import sys; sys.path.insert(0, sys.argv[2]); from agent import graph; "
ALONE += "graph(open(sys.argv[1], 'rb').read()); print('torch' in sys.modules)"
Tick = Callable[..., Sequence[Tensor]]


class Robot:
    """A ground robot whose actuators fail, and a plan for it.

    Args:
        family: of :func:`~afm_rl.regimes.actuator_regimes`; none stays healthy.
        ticks: how many there will be.
        seed: of plan, regimes and noise.
    """

    def __init__(self, family: str, ticks: int, seed: int) -> None:
        families = actuator_regimes(LOW.tolist(), HIGH.tolist())
        self.regime = Compose({family: families[family]}) if family in families else None
        self.random = torch.Generator().manual_seed(seed)
        self.model, self.state, self.ticks, self.k = Dubins(), torch.zeros(3), ticks, 0
        self.past, self.plan = torch.zeros(10, 2), torch.zeros(2)
        self.missed: list[Tensor] = []

    def planned(self) -> Tensor:
        """Return the next planned action."""
        fresh = 2 * torch.rand(2, generator=self.random) - 1
        self.plan = (0.7 * self.plan + 0.5 * fresh).clamp(-0.8, 0.8)
        if self.regime is not None and self.k % (self.ticks // 5) == self.ticks // 10:
            self.row = self.regime.sample((), self.random)
        self.k += 1
        return self.plan * HIGH

    def move(self, action: Tensor) -> None:
        """Execute an action."""
        effect, noise = action, torch.randn(2, generator=self.random)
        if self.regime is not None and self.k > self.ticks // 10:
            effect = self.regime.apply(action, self.row, self.state, self.past, noise)
        self.past = shifted(self.past, action)
        self.missed.append(((effect - self.plan * HIGH) / HIGH).abs().mean())
        self.state = self.model(self.state, effect)


def compare(owner: Controller, graphs: Tick, robot: Robot) -> np.ndarray:
    """Return how actions differ, both times (ms), and whether all was looked at, a row per tick."""
    rows, corrector, memory = [], owner.policy.corrector, torch.zeros(owner.sizes["memory"])
    for _ in range(robot.ticks):
        given = memory, robot.state, robot.planned()
        begun = time.thread_time()
        _, found = graphs(*(x.numpy() for x in given))
        between = time.thread_time()
        memory, action = owner(*given)
        ended = time.thread_time()
        difference = (torch.from_numpy(found) - action) / HIGH
        parts = corrector.unpack(memory[-corrector.memory_size(3) :], 3)
        corrects = parts["misaligned"].item()
        times = 1e3 * (between - begun), 1e3 * (ended - between)
        rows.append([difference.abs().max().item(), *times, corrects])
        robot.move(action)
    return np.array(rows)


def closed(tick: Tick, sizes: int, family: str, ticks: int, seed: int) -> float:
    """Return the mean error of the effects, a share of the largest action, of a drive."""
    robot, memory = Robot(family, ticks, seed), torch.zeros(sizes)
    for _ in range(ticks):
        memory, action = tick(memory, robot.state, robot.planned())
        robot.move(action)
    return torch.stack(robot.missed).mean().item()


@torch.inference_mode()
def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ticks", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=6)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    owner: Controller = controller(planned=False, core="eager")
    with tempfile.TemporaryDirectory() as folder, torch.inference_mode(False):
        path = Path(folder) / "policy.onnx"
        export_controller(owner, path)
        code = path.read_bytes()
        run = [sys.executable, "-c", ALONE, str(path), sys.path[0]]
        out = subprocess.run(run, capture_output=True, text=True, check=True).stdout
    print(f"bytes: {len(code):,} (limit {SIZE:,.0f}); torch loaded to run it: {out.strip()}")
    run_graph, size = graph(code)[0], owner.sizes["memory"]

    def as_tensors(*given: Tensor) -> list[Tensor]:
        return [torch.from_numpy(x) for x in run_graph(*(x.numpy() for x in given))]

    families = ["healthy", *actuator_regimes(LOW.tolist(), HIGH.tolist())]
    print(
        f"{'family':14}{'median':>10}{'largest':>10}{'ties':>6}{'torch':>16}{'graph, closed':>18}"
    )
    every = []
    for seed, family in enumerate(families):
        rows = compare(owner, run_graph, Robot(family, asked.ticks, seed))
        every.append(rows)
        errors = [
            [closed(tick, size, family, asked.ticks // 4, k) for k in range(asked.seeds)]
            for tick in (owner, as_tensors)
        ]
        loops = [f"{np.mean(e):.4f} +- {1.96 * np.std(e) / len(e) ** 0.5:.4f}" for e in errors]
        apart = rows[:, 0]
        ties = int((apart > EQUAL).sum())
        sizes = f"{np.median(apart):10.0e}{apart.max():10.0e}{ties:6}"
        print(f"{family:14}{sizes}{loops[0]:>18}{loops[1]:>18}", flush=True)
    rows = np.concatenate(every)
    share = (rows[:, 0] > EQUAL).mean()
    print(f"of {len(rows)} ticks {share:.3%} differ by more than {EQUAL:g} (limit {TIES:.1%})")
    print(f"{'ms a tick':14}{'p50':>8}{'p99':>8}{'limit':>8}{'torch, p50':>12}")
    for name, corrects, limit in (("silent", 0, SILENT), ("correcting", 1, CORRECTING)):
        took = rows[rows[:, 3] == corrects][:, 1:3]
        p50, p99 = np.quantile(took[:, 0], [0.5, 0.99])
        print(f"{name:14}{p50:8.2f}{p99:8.2f}{limit:8.2f}{np.median(took[:, 1]):12.2f}")


if __name__ == "__main__":
    main()
