"""Control steps per second of the whole loop, against the customary one.

    python benchmarks/bench_throughput.py [--rounds 12] [--population 1000] [--missions 22]

A step plans (MPPI, horizon 5, ensemble of 5 x (200, 200, 200)), acts and learns from the
transition; every mission has parameters of its own. Customary means one mission at a time,
members in a Python loop and a new Adam per member (benchmarks/customary.py); ours is a batch
of missions. float32 and one thread unless the table says otherwise. All take turns within one
run, so the ratios hold when the machine's speed drifts.
"""

from __future__ import annotations

import argparse
import multiprocessing as mp
import os
import time
from collections.abc import Callable
from functools import partial
from statistics import median

import torch
from customary import Customary
from tensordict import TensorDict
from timing import timed

from afm_rl.dynamics import Dubins, Ensemble
from afm_rl.learning import GaussianNLLLoss, OnlineUpdater, ResetAdam
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
from afm_rl.spaces.manifold import Manifold

LOW, HIGH, HIDDEN = torch.tensor([-1.0, -1.57]), torch.tensor([1.0, 1.57]), (200, 200, 200)
CUSTOMARY = "customary"
OURS = {
    f"ours, {propagation}, {precision}": {"propagation": propagation, "precision": precision}
    for propagation in ("mean", "member")
    for precision in ("float32", "bfloat16")
}


class Batch:
    """Our loop: missions in one batch, each with parameters of its own."""

    def __init__(self, missions: int, population: int, **settings: str) -> None:
        model = Ensemble(
            Manifold(3, angles=[2]), 2, features=[2], hidden=HIDDEN, **settings
        ).expand_(missions)
        world = PlanningEnv(model, GoalDistance(), LOW, HIGH)
        self.planner = MPPI(world, horizon=5, population=population, seed_key="seed")
        self.updater = OnlineUpdater(GaussianNLLLoss(model), ResetAdam)
        self.world = Dubins()
        self.td = TensorDict(
            {
                "observation": torch.zeros(missions, 3),
                "goal": torch.ones(missions, 2),
                "seed": torch.zeros(missions, dtype=torch.long),
                "mppi": {"mean": torch.zeros(missions, 5, 2)},
            },
            [missions],
        )

    @torch.no_grad()
    def __call__(self) -> None:
        """Take one control step with every mission."""
        td = self.planner(self.td)
        reached = self.world(td["observation"], 0.8 * td["action"])
        self.updater(td.set(("next", "observation"), reached))
        mean = td["next", "mppi", "mean"]
        self.td = td.exclude("next", "action").set(("mppi", "mean"), mean)
        self.td["observation"] = reached


def make(name: str, missions: int, population: int) -> tuple[Callable[[], None], int]:
    """Return a loop and how many missions it takes a step with."""
    if name == CUSTOMARY:
        return Customary(LOW, HIGH, HIDDEN, population), 1
    return Batch(missions, population, **OURS[name]), missions


def serve(link, name: str, missions: int, population: int, seconds: float) -> None:
    """Send the steps per second of one process, measured when told to start."""
    torch.set_num_threads(1)
    job, size = make(name, missions, population)
    for _ in range(2):
        job()
    link.send(None)
    link.recv()
    start, steps = time.perf_counter(), 0
    while time.perf_counter() < start + seconds:
        job()
        steps += size
    link.send(steps / (time.perf_counter() - start))


def together(name: str, missions: int, population: int, seconds: float, count: int = 2) -> float:
    """Return the steps per second of ``count`` processes at once, summed."""
    context = mp.get_context("spawn")
    links, processes = [], []
    for _ in range(count):
        here, there = context.Pipe()
        process = context.Process(target=serve, args=(there, name, missions, population, seconds))
        process.start()
        links.append(here)
        processes.append(process)
    for order in (lambda link: link.recv(), lambda link: link.send(None)):
        for link in links:
            order(link)
    rate = sum(link.recv() for link in links)
    for process in processes:
        process.join()
    return rate


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description="Control steps per second.")
    parser.add_argument("--rounds", type=int, default=12, help="turns of every loop")
    parser.add_argument("--population", type=int, default=1000, help="candidates per plan")
    parser.add_argument("--missions", type=int, default=22, help="missions in our batch")
    options = parser.parse_args()
    torch.set_num_threads(1)
    settings = options.missions, options.population
    made = {name: make(name, *settings) for name in (CUSTOMARY, *OURS)}
    spent = timed({name: job for name, (job, _) in made.items()}, options.rounds, warm_up=1)
    per_step = {name: [ms / made[name][1] for ms in values] for name, values in spent.items()}
    print(f"{options.missions} missions, {options.population} candidates, one process")
    print(f"{'':28}{'ms / step':>12}{'steps / s':>12}{'x customary':>14}")
    gains = {}
    for name, values in per_step.items():
        pairs = zip(per_step[CUSTOMARY], values, strict=True)
        gains[name] = median(theirs / ours for theirs, ours in pairs)
        ms = median(values)
        print(f"{name:28}{ms:12.2f}{1e3 / ms:12.1f}{gains[name]:14.2f}")
    if (os.cpu_count() or 1) < 2:
        return
    best = sorted(OURS, key=lambda name: -gains[name])[:2]
    measure = partial(together, missions=options.missions, population=options.population)
    rates = {name: measure(name, seconds=options.rounds / 4) for name in (CUSTOMARY, *best)}
    print("two processes at once")
    for name, rate in rates.items():
        print(f"{name:28}{'':12}{rate:12.1f}{rate / rates[CUSTOMARY]:14.2f}")


if __name__ == "__main__":
    main()
