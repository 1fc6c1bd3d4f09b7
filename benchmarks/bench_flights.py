"""Flights of the quadrotor: seconds alone, in a batch, and with networks that learn on the way.

    python benchmarks/bench_flights.py [--rounds 3] [--flights 25]

A flight takes 8 s: 160 control ticks, 4000 plant steps. One thread; everything takes turns within
one run, so the ratios hold when the machine's speed drifts. Seconds are those of the processor.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from statistics import median

import torch
from hydra import compose, initialize_config_module
from tensordict import TensorDictBase
from timing import timed

from afm_rl.dynamics import KNODE
from afm_rl.missions import build, run
from afm_rl.missions.build import Agent

DURATION = 8.0  # of a flight, s
TICKS = 100  # planned, for the time of one


def make(*overrides: str) -> Agent:
    """Return the agent that the command line would build."""
    with initialize_config_module("afm_rl.conf", version_base="1.3"):
        return build(compose("config", ["robot=quadrotor", *overrides]))


def fly(*overrides: str) -> float:
    """Return the seconds that flights take from start to end, without building the agent."""
    agent = make(*overrides)  # agents learn in place, so each flight has its own
    start = time.process_time()
    run(agent)
    return time.process_time() - start


def plan(*overrides: str) -> Callable[[], object]:
    """Return a job that plans a tick: with networks, their pool is full."""
    agent = make(*overrides)
    model = agent.model
    if isinstance(model, KNODE):
        for _ in range(model.pool):
            model.push_()
    data: TensorDictBase = agent.env.reset(agent.missions, set_state=False)
    with torch.no_grad():
        for _ in range(3):  # until its memory is warm
            data = agent.env.step_mdp(agent.env.step(agent.planner(data)))
    return lambda: agent.planner(data.clone())


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description="Seconds per flight.")
    parser.add_argument("--rounds", type=int, default=3, help="turns of every job")
    parser.add_argument("--flights", type=int, default=25, help="flights in the batch")
    options = parser.parse_args()
    torch.set_num_threads(1)
    jobs = {
        "physics": ["method=physics"],
        "physics, batch": ["method=physics", f"seeds={options.flights}"],
        "online_knode": ["method=online_knode"],
        "online_knode, batch": ["method=online_knode", f"seeds={options.flights}"],
    }
    fly("method=physics")  # what is loaded late
    spent: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(options.rounds):
        for name, overrides in jobs.items():
            spent[name].append(fly(*overrides))
    seconds = {name: median(values) for name, values in spent.items()}
    print(f"{'':24}{'s':>8}{'s / flight':>12}{'x real time':>13}{'x one by one':>14}")
    for name, value in seconds.items():
        alone, _, kind = name.partition(", ")
        each = value / (options.flights if kind else 1)
        gain = f"{seconds[alone] / each:14.1f}" if kind else ""
        print(f"{name:24}{value:8.2f}{each:12.3f}{DURATION / each:13.1f}{gain}")
    ticks = timed(
        {"physics": plan("method=physics"), "three networks": plan("method=online_knode")}, TICKS
    )
    for name, values in ticks.items():
        print(f"planning a tick, {name}: {median(values):.2f} ms")


if __name__ == "__main__":
    main()
