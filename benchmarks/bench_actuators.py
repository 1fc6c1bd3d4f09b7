"""A policy that runs, actuators that change: what each corrector brings back.

    python benchmarks/bench_actuators.py --episodes 3

gymnasium's HalfCheetah-v5 and the linear policy of `examples/policies`, or one that
`examples/policies/train_sac.py` stored (`--policy FILE`); the model is the very same simulation.
From step 300 of 1000 on the actuators differ. Shown: the return of the last 500 steps, doubled.
`alone` is the policy by itself, `ideal` the exact inverse from ten steps after the change.
Finished episodes stand in a file and are not run again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from statistics import mean

import gymnasium
import numpy as np
import torch
from safetensors.torch import load_file

from afm_rl.correction import ActionFlow, LeastSquares
from afm_rl.dynamics import MuJoCoDynamics
from afm_rl.planning import load_policy

POLICY = Path(__file__).parents[1] / "examples" / "policies" / "half_cheetah.safetensors"
AT, LATE, STEPS = 300, 10, 1000
LOW, HIGH = -torch.ones(6, dtype=torch.float64), torch.ones(6, dtype=torch.float64)
ONES, ORDER = np.ones(6), np.arange(6)
BACK, SWAPPED = ORDER == 0, np.array([3, 1, 2, 0, 4, 5])  # actuators 0 and 3 are the thighs
CHANGES = {  # gain, offset, which command drives an actuator
    "nothing": (ONES, 0.0, ORDER),
    "back thigh reversed": (np.where(BACK, -1.0, 1.0), 0.0, ORDER),
    "all reversed": (-ONES, 0.0, ORDER),
    "all at half": (0.5 * ONES, 0.0, ORDER),
    "all biased by .3": (ONES, 0.3, ORDER),
    "thighs swapped": (ONES, 0.0, SWAPPED),
    "back thigh dead": (np.where(BACK, 0.0, 1.0), 0.0, ORDER),
}
CORRECTORS = {
    "alone": None,
    "ideal": None,
    "gain": lambda: LeastSquares(LOW, HIGH),
    "gain_offset": lambda: LeastSquares(LOW, HIGH, "gain_offset", window=12),
    "affine": lambda: LeastSquares(LOW, HIGH, "affine"),
    "afm": lambda: ActionFlow(LOW, HIGH),
}


def linear(weights: dict[str, torch.Tensor]) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return the linear policy with these weights."""
    weight, bias = weights["weight"].double(), weights["bias"].double()
    return lambda observation: (weight @ observation + bias).clamp(-1, 1)


class Bed:
    """The robot, its policy and its model."""

    def __init__(self, policy: Path | None) -> None:
        self.env = gymnasium.make("HalfCheetah-v5")
        self.model = MuJoCoDynamics(self.env)
        self.policy = load_policy(policy)[0] if policy else linear(load_file(POLICY))

    def state(self) -> torch.Tensor:
        """Return the state, which the observation tells but for the distance."""
        data = self.env.unwrapped.data
        return torch.from_numpy(np.concatenate([data.qpos, data.qvel]))

    @torch.no_grad()
    def episode(self, change: str, name: str, seed: int) -> float:
        """Return twice the return of the second half of an episode."""
        gain, offset, order = CHANGES[change]
        inverse = np.empty(6)
        corrector = CORRECTORS[name] and CORRECTORS[name]()
        observation, _ = self.env.reset(seed=seed)
        memory = corrector.begin(self.state()) if corrector else None
        box, total = torch.stack([LOW, HIGH]), 0.0
        for step in range(STEPS):
            action = self.policy(torch.from_numpy(observation)).numpy()
            if corrector:
                planned = torch.from_numpy(action)
                memory, found = corrector.correct(memory, planned, self.model, box)
                action = found.executed.numpy()
            elif name == "ideal" and step >= AT + LATE:
                inverse[order] = (action - offset) / np.where(gain == 0, 1.0, gain)
                action = np.clip(inverse, -1, 1)
            if step >= AT:
                action = np.clip(gain * action[order] + offset, -1, 1)
            observation, reward, *_ = self.env.step(action)
            if corrector:
                memory = corrector.observe(memory, self.state())
            total += reward if step >= STEPS // 2 else 0.0
        return 2 * total


def main() -> None:
    """Print a table, and how long an episode took."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", type=Path, help="stored policy; left out: the linear one")
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--correctors", nargs="+", choices=CORRECTORS, default=list(CORRECTORS))
    parser.add_argument("--changes", nargs="+", choices=CHANGES, default=list(CHANGES))
    parser.add_argument("--out", type=Path, default=Path("outputs/actuators.jsonl"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    lines = args.out.read_text().splitlines() if args.out.exists() else []
    done = {tuple(row[:3]): row[3] for row in map(json.loads, lines)}
    bed = Bed(args.policy)
    for change in args.changes:
        for name in args.correctors:
            for seed in range(args.episodes):
                if (change, name, seed) in done:
                    continue
                start = time.process_time()
                done[change, name, seed] = bed.episode(change, name, seed)
                spent = time.process_time() - start
                with args.out.open("a") as file:
                    row = [change, name, seed, done[change, name, seed], round(spent, 1)]
                    file.write(json.dumps(row) + "\n")
        cells = {
            name: [done[change, name, k] for k in range(args.episodes)] for name in args.correctors
        }
        shown = "  ".join(f"{name} {mean(values):.0f}" for name, values in cells.items())
        print(f"{change}: {shown}", flush=True)


if __name__ == "__main__":
    main()
