"""MPPI of three libraries on one problem: time of a plan, and cost of the plans.

    pip install pytorch_mppi==0.9.1   # to include it in the table
    python benchmarks/bench_mppi.py

A robot with differential drive plans 100 steps of 0.02 s around the obstacles of a map of 11 x 11 m
with cells of 0.1 m, at temperature 1 with noise of standard deviation 0.2. The cost of a step is
the distance to the goal, the deviation from the goal's heading and the map's value. One thread;
processor time; all planners in turns within one process, so that ratios hold if the speed of the
machine drifts. Then each planner drives for four seconds with 1024 samples.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from statistics import median

import pandas as pd
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from timing import timed
from torch import Tensor
from torchrl.modules import MPPIPlanner
from torchrl.objectives.value import TDLambdaEstimator

from afm_rl.dynamics import Dubins
from afm_rl.planning import MPPI, Cost, PlanningEnv
from afm_rl.report.tables import markdown

try:
    from pytorch_mppi import MPPI as Peer
except ImportError:
    Peer = None

SAMPLES, HORIZON, DT = (128, 1024, 2048), 100, 0.02
TEMPERATURE, SIGMA = 1.0, 0.2
SIDE, CELL, ORIGIN = 110, 0.1, -5.5  # of the map
LOW, HIGH = torch.tensor([-2.0, -2.0]), torch.tensor([2.0, 2.0])
START, GOAL = torch.tensor([-4.0, -4.0, 0.0]), torch.tensor([0.0, 0.0, 0.785])


def obstacles() -> Tensor:
    """Return the map as one row: 100 inside of discs, falling to 0 within half a metre."""
    middle = ORIGIN + CELL * (torch.arange(SIDE) + 0.5)
    discs = torch.tensor([[-3.2, -3.4], [-2.5, -3.9], [-1.0, -1.5], [1.0, 0.5], [2.0, 3.0]])
    x, y = torch.meshgrid(middle, middle, indexing="ij")
    far = (torch.stack([x, y], -1).unsqueeze(-2) - discs).norm(dim=-1).amin(-1) - 0.3
    return (100 * (1 - far / 0.5).clamp(0, 1)).flatten()


class MapCost(Cost):
    """Distance to the goal, deviation from its heading, and the value of the map."""

    in_keys, in_sizes = ["goal"], [3]

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("map", obstacles())

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, *task: Tensor) -> Tensor:
        """Return the cost ``(*B)``."""
        x, y, theta = next_state.unbind(-1)
        gx, gy, heading = task[0].unbind(-1)
        column, row = (((at - ORIGIN) / CELL).int().clamp(0, SIDE - 1) for at in (x, y))
        there = self.map.index_select(0, (column * SIDE + row).flatten()).view_as(x)
        far = ((x - gx).square() + (y - gy).square()).sqrt()
        return far + 0.2 * (1 - (theta - heading).cos()) + there


def ours(samples: int, **settings) -> Callable[[Tensor], Tensor]:
    """Return this library's planner as a function of the state."""
    env = PlanningEnv(Dubins(DT), MapCost(), LOW, HIGH)
    planner = MPPI(env, HORIZON, samples, temperature=TEMPERATURE, sigma=SIGMA, **settings)
    planner.scale.fill_(SIGMA)  # the problem's noise is the same for both actions
    td = TensorDict({"goal": GOAL, ("mppi", "mean"): torch.zeros(HORIZON, 2)})

    def plan(state: Tensor) -> Tensor:
        planner(td.set("observation", state))
        td["mppi"] = td["next", "mppi"]
        return td["action"]

    return plan


def torchrl(samples: int) -> Callable[[Tensor], Tensor]:
    """Return TorchRL's planner, with one iteration and without a warm start."""
    env = PlanningEnv(Dubins(DT), MapCost(), LOW, HIGH)
    nothing = TensorDictModule(  # is expected beyond the horizon
        lambda state: torch.zeros_like(state[..., :1]), ["observation"], ["state_value"]
    )
    returns = TDLambdaEstimator(gamma=1.0, lmbda=1.0, value_network=nothing)
    # It does not subtract the best return, so at an inverse temperature of 1 all weights are zero.
    planner = MPPIPlanner(env, returns, 0.01, HORIZON, 1, samples, samples // 10)
    td = TensorDict({"goal": GOAL})
    return lambda state: planner(td.set("observation", state))["action"]


def peer(samples: int) -> Callable[[Tensor], Tensor]:
    """Return pytorch_mppi's planner."""
    cost, still = MapCost(), torch.zeros(2)

    def model(state: Tensor, action: Tensor) -> Tensor:
        x, y, theta = state.unbind(-1)
        stride, turn = (DT * action).unbind(-1)
        return torch.stack([x + stride * theta.cos(), y + stride * theta.sin(), theta + turn], -1)

    return Peer(
        model,
        lambda state, action: cost(state, action, state, GOAL),
        nx=3,
        noise_sigma=torch.eye(2) * SIGMA**2,
        num_samples=samples,
        horizon=HORIZON,
        lambda_=TEMPERATURE,
        u_min=LOW,
        u_max=HIGH,
        U_init=still.expand(HORIZON, -1).clone(),
    ).command


def driven(plan: Callable[[Tensor], Tensor], ticks: int) -> float:
    """Return the mean cost of a step of a drive."""
    model, cost, state, total = Dubins(DT), MapCost(), START, 0.0
    for _ in range(ticks):
        state = model(state, plan(state))
        total += float(cost(state, state, state, GOAL))
    return total / ticks


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--samples", type=int, nargs="+", default=SAMPLES)
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--ticks", type=int, default=200, help="steps that are driven")
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    kinds: dict[str, Callable[[int], Callable[[Tensor], Tensor]]] = {
        "afm-rl": lambda samples: ours(samples, beta=1.0),
        "afm-rl, smoothed plans": ours,
        "TorchRL": torchrl,
    }
    if Peer is None:
        print("pytorch_mppi is not installed, so its row is missing: pip install pytorch_mppi")
    else:
        kinds["pytorch_mppi"] = peer
    spent = []
    for count in options.samples:
        jobs = {name: make(count) for name, make in kinds.items()}
        calls = {name: lambda job=job: job(START) for name, job in jobs.items()}
        for call in calls.values():
            call()
        spent.append(timed(calls, options.rounds, clock=time.thread_time))
    heads = ["samples", *options.samples, "driven"]
    rows = [
        [name, *(f"{median(times[name]):.1f}" for times in spent)]
        + [f"{driven(make(1024), options.ticks):.3f}"]
        for name, make in kinds.items()
    ]
    print(markdown("ms per plan", pd.DataFrame(rows, columns=heads)))


if __name__ == "__main__":
    main()
