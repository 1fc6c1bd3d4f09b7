"""Simulation steps per second of `MuJoCoDynamics.rollout` against `mujoco.rollout` alone.

    python benchmarks/bench_mujoco.py

Plans of gymnasium's Reacher (64 candidates, horizon 20) and HalfCheetah (64, 20), timed in turns
within one run, so the ratios hold when the machine's speed drifts.
"""

from __future__ import annotations

from functools import partial
from statistics import median

import gymnasium
import numpy as np
import torch
from mujoco import rollout
from timing import timed

from afm_rl.dynamics import MuJoCoDynamics

CANDIDATES, HORIZON, ROUNDS = 64, 20, 15


def main() -> None:
    """Print a table."""
    torch.set_num_threads(1)
    for task in ("Reacher-v5", "HalfCheetah-v5"):
        env = gymnasium.make(task)
        for threads in (0, 2):
            model = MuJoCoDynamics(env, threads=threads)
            inner, skip, *_ = model.step.settings
            state = torch.zeros(model.state_size)
            plans = 2 * torch.rand(CANDIDATES, HORIZON, model.action_size) - 1
            first = np.repeat(model.step.rest[None], CANDIDATES, 0)
            controls = np.repeat(plans.double().numpy(), skip, 1)
            pool, data = rollout.Rollout(nthread=threads), model.step.data
            spent = timed(
                {
                    "alone": partial(pool.rollout, inner, data, first, controls),
                    "model": partial(model.rollout, state, plans),
                },
                ROUNDS,
            )
            rate = {name: CANDIDATES * HORIZON * skip / median(ms) for name, ms in spent.items()}
            print(
                f"{task}, threads {threads}: mujoco.rollout {rate['alone']:.0f}, MuJoCoDynamics "
                f"{rate['model']:.0f} thousand steps/s ({rate['model'] / rate['alone']:.0%})"
            )


if __name__ == "__main__":
    main()
