r"""Train a linear policy for gymnasium's HalfCheetah by augmented random search.

    python examples/policies/train_linear.py

Mania et al. 2018, arXiv 1803.07055: :math:`a = \mathrm{clip}(W z)` with the normalised
observation z, W moved along random directions by the difference of their returns. All directions
are simulated at once by a `MuJoCoDynamics`, so that a few minutes of one core are enough. From
half of the time on, ten steps of every episode run with actuators reversed, so that the policy
learns to catch itself.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import gymnasium
import numpy as np
import torch
from safetensors.torch import save_file

from afm_rl.dynamics import MuJoCoDynamics

DIRECTIONS, BEST, NOISE, RATE = 12, 8, 0.03, 0.02
FILE = Path(__file__).with_name("half_cheetah.safetensors")


class Trainer:
    """Policies ``(N, A, O)`` tried side by side."""

    def __init__(self, seed: int) -> None:
        env = gymnasium.make("HalfCheetah-v5")
        self.model, self.dt = MuJoCoDynamics(env), env.unwrapped.dt
        self.random = np.random.default_rng(seed)
        self.weight = np.zeros((6, 17))
        self.mean, self.variance, self.count = np.zeros(17), np.ones(17), 1e-4

    def returns(self, weights: np.ndarray, steps: int, kicked: bool) -> np.ndarray:
        """Return the returns ``(N,)`` of one episode each, all from the same start."""
        state = np.tile(0.1 * self.random.standard_normal(18), (len(weights), 1))
        kick, signs = self.random.integers(100), self.random.choice([-1.0, 1.0], 6)
        total, seen = np.zeros(len(weights)), []
        for step in range(steps):
            seen.append(state[:, 1:])
            unit = (state[:, 1:] - self.mean) / np.sqrt(self.variance)
            action = np.clip(np.einsum("nao,no->na", weights, unit), -1, 1)
            if kicked and kick <= step < kick + 10:
                action = action * signs
            after = self.model.step(state, action[:, None])[:, 0]
            total += (after[:, 0] - state[:, 0]) / self.dt - 0.1 * np.square(action).sum(-1)
            state = after
        self._normalise(np.concatenate(seen))
        return total

    def _normalise(self, seen: np.ndarray) -> None:
        both, shift = self.count + len(seen), seen.mean(0) - self.mean
        share = len(seen) / both
        spread = self.variance * (1 - share) + seen.var(0) * share
        self.variance = np.maximum(spread + shift**2 * share * (1 - share), 1e-4)
        self.mean, self.count = self.mean + shift * share, min(both, 3e5)

    def improve(self, steps: int, kicked: bool) -> float:
        """Take one step; return the mean return of 1000 steps."""
        moves = self.random.standard_normal((DIRECTIONS, 6, 17))
        tried = np.concatenate([self.weight + NOISE * moves, self.weight - NOISE * moves])
        ahead, behind = self.returns(tried, steps, kicked).reshape(2, -1)
        best = np.argsort(-np.maximum(ahead, behind))[:BEST]
        spread = np.concatenate([ahead[best], behind[best]]).std() + 1e-6
        step = np.einsum("k,kao->ao", (ahead - behind)[best], moves[best])
        self.weight = self.weight + RATE / (BEST * spread) * step
        return float(ahead.mean() * 1000 / steps)

    def save(self, file: Path) -> None:
        """Write the policy as a plain affine map of the observation."""
        weight = torch.from_numpy(self.weight / np.sqrt(self.variance))
        part = file.with_suffix(".part")
        save_file({"weight": weight, "bias": -weight @ torch.from_numpy(self.mean)}, part)
        part.replace(file)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=FILE)
    args = parser.parse_args()
    trainer, start, round_ = Trainer(args.seed), time.process_time(), 0
    while (spent := (time.process_time() - start) / 60) < args.minutes:
        kicked = spent > args.minutes / 2
        mean = trainer.improve(320 if kicked else 250, kicked)
        if round_ % 20 == 0:
            print(f"{spent:.1f} min: {mean:.0f} per 1000 steps", flush=True)
        round_ += 1
    trainer.save(args.out)


if __name__ == "__main__":
    main()
