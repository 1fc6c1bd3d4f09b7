"""A policy that runs, actuators that change: what each corrector brings back.

    python benchmarks/bench_actuators.py --episodes 3

gymnasium's HalfCheetah-v5 and a policy that `examples/policies/train_sac.py` trained; the model is
the very same simulation, as it was before the change. From step 300 of 1000 on the actuators or the
physics differ. Shown: the return of the last 500 steps, doubled, mean [worst, best] of episodes.
`alone` is the policy by itself, `ideal` the exact inverse from ten steps after the change, where
there is one. Finished episodes stand in a file and are not run again.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch

from afm_rl.correction import ActionFlow, LeastSquares
from afm_rl.dynamics import MuJoCoDynamics
from afm_rl.planning import load_policy

POLICY = Path(__file__).parents[1] / "examples" / "policies" / "half_cheetah_sac.safetensors"
AT, LATE, STEPS = 300, 10, 1000
LOW, HIGH = -torch.ones(6, dtype=torch.float64), torch.ones(6, dtype=torch.float64)
PHYSICS = ("body_mass", "body_inertia", "geom_friction")


class Change(NamedTuple):
    """What is different from the change on."""

    gain: Any = 1.0
    offset: float = 0.0
    order: tuple[int, ...] = (0, 1, 2, 3, 4, 5)  # which command drives an actuator
    late: int = 0  # steps
    physics: tuple[float, float, float] = (1.0, 1.0, 1.0)  # factors on mass, inertia, friction
    gravity: float = 1.0  # factor


def of_back_thigh(gain: float) -> np.ndarray:
    """Return gains of which only the first one differs."""
    return np.array([gain, 1, 1, 1, 1, 1])


CHANGES = {
    "nothing": Change(),
    "back thigh reversed": Change(of_back_thigh(-1.0)),
    "all reversed": Change(-1.0),
    "all at half": Change(0.5),
    "all biased by .3": Change(offset=0.3),
    "thighs swapped": Change(order=(3, 1, 2, 0, 4, 5)),
    "back thigh dead": Change(of_back_thigh(0.0)),
    "late by 1 step": Change(late=1),
    "late by 2 steps": Change(late=2),
    "late by 4 steps": Change(late=4),
    "mass times 1.5": Change(physics=(1.5, 1.5, 1.0)),
    "friction times .5": Change(physics=(1.0, 1.0, 0.5)),
    "gravity times 1.3": Change(gravity=1.3),
}
CORRECTORS = {
    "alone": None,
    "ideal": None,
    "gain": lambda: LeastSquares(LOW, HIGH),
    "gain_offset": lambda: LeastSquares(LOW, HIGH, "gain_offset", window=12),
    "affine": lambda: LeastSquares(LOW, HIGH, "affine"),
    "afm": lambda: ActionFlow(LOW, HIGH),
}


class Bed:
    """The robot, its policy and its model."""

    def __init__(self, policy: Path) -> None:
        self.env = gymnasium.make("HalfCheetah-v5")
        self.model = MuJoCoDynamics(self.env)
        self.policy = load_policy(policy)[0]
        self.world = self.env.unwrapped.model
        self.nominal = {name: getattr(self.world, name).copy() for name in PHYSICS}
        self.gravity = self.world.opt.gravity.copy()

    def state(self) -> torch.Tensor:
        """Return the state, which the observation tells but for the distance."""
        data = self.env.unwrapped.data
        return torch.from_numpy(np.concatenate([data.qpos, data.qvel]))

    def set_physics(self, change: Change) -> None:
        """Change the robot, not its model."""
        for name, factor in zip(PHYSICS, change.physics, strict=True):
            getattr(self.world, name)[:] = factor * self.nominal[name]
        self.world.opt.gravity[:] = change.gravity * self.gravity

    @torch.no_grad()
    def episode(self, change: Change, name: str, seed: int) -> float:
        """Return twice the return of the second half of an episode."""
        order, inverse = list(change.order), np.empty(6)
        corrector = CORRECTORS[name] and CORRECTORS[name]()
        self.set_physics(Change())
        observation, _ = self.env.reset(seed=seed)
        memory = corrector.begin(self.state()) if corrector else None
        box, total, sent = torch.stack([LOW, HIGH]), 0.0, []
        for step in range(STEPS):
            action = self.policy(torch.from_numpy(observation)).numpy()
            if corrector:
                planned = torch.from_numpy(action)
                memory, found = corrector.correct(memory, planned, self.model, box)
                action = found.executed.numpy()
            elif name == "ideal" and step >= AT + LATE:
                gain = np.where(np.equal(change.gain, 0), 1.0, change.gain)
                inverse[order] = (action - change.offset) / gain
                action = np.clip(inverse, -1, 1)
            sent.append(action)
            if step >= AT:
                self.set_physics(change)
                action = np.clip(change.gain * sent[-1 - change.late][order] + change.offset, -1, 1)
            observation, reward, *_ = self.env.step(action)
            if corrector:
                memory = corrector.observe(memory, self.state())
            total += reward if step >= STEPS // 2 else 0.0
        return 2 * total


def main() -> None:
    """Print a table, and how long an episode took."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", type=Path, default=POLICY)
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
                done[change, name, seed] = bed.episode(CHANGES[change], name, seed)
                spent = time.process_time() - start
                with args.out.open("a") as file:
                    row = [change, name, seed, done[change, name, seed], round(spent, 1)]
                    file.write(json.dumps(row) + "\n")
        cells = {
            name: [done[change, name, k] for k in range(args.episodes)] for name in args.correctors
        }
        shown = "  ".join(
            f"{name} {mean(values):.0f} [{min(values):.0f}, {max(values):.0f}]"
            for name, values in cells.items()
        )
        print(f"{change}: {shown}", flush=True)


if __name__ == "__main__":
    main()
