r"""Train a policy with soft actor-critic, for any gymnasium task, on one core.

    python examples/policies/train_sac.py --id HalfCheetah-v5 --out cheetah.safetensors

Run `pip install 'afm-rl[gym,sb3]'` first, because it uses Stable-Baselines3. `--randomise` draws
other actuators for each episode, the usual remedy against changes. The file has the mean action,
for
`afm_rl.planning.load_policy`. The files beside this one were trained with the same settings, by a
loop of our own that this one replaces.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import gymnasium
import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from afm_rl import FaultWrapper
from afm_rl.planning import policy_from_sb3, save_policy


class RandomActuators(FaultWrapper):
    """Other actuators in every episode: healthy, one reversed, all weak, one dead, or biased."""

    def __init__(self, env: gymnasium.Env, seed: int) -> None:
        super().__init__(env)
        self.random = np.random.default_rng(seed)

    def reset(self, **options):
        size = len(self.action_space.low)
        kind = self.random.choice(["healthy", "reversed", "weak", "dead", "biased"])
        if kind == "weak":
            fault = {f"gain_{k}": x for k, x in enumerate(self.random.uniform(0.3, 1.0, size))}
        elif kind == "biased":
            fault = {f"bias_{k}": x for k, x in enumerate(self.random.uniform(-0.3, 0.3, size))}
        else:
            gains = {"healthy": 1.0, "reversed": -1.0, "dead": 0.0}
            fault = {f"gain_{self.random.integers(size)}": gains[kind]}
        self.fail(fault)
        return super().reset(**options)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--id", default="HalfCheetah-v5", help="a task of gymnasium")
    parser.add_argument("--steps", type=int, default=120_000)
    parser.add_argument("--first", type=int, default=5000, help="steps of random actions")
    parser.add_argument("--units", type=int, default=128, help="width of the actor")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--randomise", action="store_true", help="other actuators per episode")
    parser.add_argument("--out", type=Path, required=True, help="file of the policy")
    args = parser.parse_args()
    torch.set_num_threads(1)
    env = gymnasium.make(args.id)
    model = SAC(
        "MlpPolicy",
        Monitor(RandomActuators(env, args.seed) if args.randomise else env),
        learning_starts=args.first,
        policy_kwargs={"net_arch": {"pi": [args.units] * 2, "qf": [256, 256]}},
        verbose=1,
        seed=args.seed,
        device="cpu",
    ).learn(args.steps)
    healthy = Monitor(gymnasium.make(args.id))
    mean, spread = evaluate_policy(model, healthy, n_eval_episodes=5)
    with tempfile.TemporaryDirectory() as folder:
        model.save(Path(folder) / "model.zip")
        policy = policy_from_sb3(Path(folder) / "model.zip")
    about = {"id": args.id, "seed": args.seed, "steps": args.steps, "randomised": args.randomise}
    save_policy(args.out, policy, {**about, "return": round(float(mean), 2)})
    print(f"{args.out}: return {mean:.1f} +- {spread:.1f}")


if __name__ == "__main__":
    main()
