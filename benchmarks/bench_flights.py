"""Flights of the quadrotor: seconds alone, in a batch, and with networks that learn on the way.

    python benchmarks/bench_flights.py [--rounds 3] [--flights 25]

A flight takes 8 s: 160 control ticks, 4000 plant steps. One thread; everything takes turns within
one run, so the ratios hold when the machine's speed drifts.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from statistics import median

import torch
from hydra import compose, initialize_config_module
from tensordict import TensorDictBase
from timing import timed

from afm_rl.dynamics import KNODE
from afm_rl.missions import build, run
from afm_rl.missions.build import Agent

TICKS = 160


def make(*overrides: str) -> Agent:
    """Return the agent that the command line would build."""
    with initialize_config_module("afm_rl.conf", version_base="1.3"):
        return build(compose("config", ["robot=quadrotor", *overrides]))


def flight(*overrides: str) -> Callable[[], object]:
    """Return a job that flies from the start: agents learn in place, so each has its own."""
    return lambda: run(make(*overrides))


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
    many = f"seeds={options.flights}"
    quiet = "robot.env.trace=false"
    spent = timed(
        {
            "build": make,  # to be taken off each flight
            "physics": flight("method=physics"),
            "physics, no trace": flight("method=physics", quiet),
            "physics, batch": flight("method=physics", many),
            "online_knode": flight("method=online_knode"),
            "online_knode, batch": flight("method=online_knode", many),
            "oracle": flight("method=oracle"),
        },
        options.rounds,
        warm_up=1,
    )
    built = median(spent.pop("build"))
    seconds = {name: (median(values) - built) / 1e3 for name, values in spent.items()}
    print(f"{'':24}{'s':>8}{'s / flight':>12}{'x real time':>13}{'x one by one':>14}")
    for name, value in seconds.items():
        alone, comma, kind = name.partition(", ")
        count = options.flights if kind == "batch" else 1
        each = value / count
        gain = f"{seconds[alone] / each:14.1f}" if count > 1 else ""
        print(f"{name:24}{value:8.2f}{each:12.3f}{8 / each:13.1f}{gain}")
    turns = spent["physics"], spent["physics, no trace"]
    extra = median(a - b for a, b in zip(*turns, strict=True)) / 1e3
    print(f"the trace adds {extra / seconds['physics']:.1%} to a flight")
    ticks = timed(
        {"physics": plan("method=physics"), "three networks": plan("method=online_knode")},
        TICKS,
    )
    for name, values in ticks.items():
        print(f"planning a tick, {name}: {median(values):.2f} ms")


if __name__ == "__main__":
    main()
