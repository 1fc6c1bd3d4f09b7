"""Make small files of policies that others trained, out of a copy of their repository.

    git clone https://github.com/DLR-RM/rl-trained-agents zoo
    python benchmarks/suites/zoo/import_policy.py zoo/trpo/Hopper-v3_1 --out hopper.safetensors

Each is then played in the present version of its task, and its return printed. The models are made
as `policy_from_sb3` makes one of a model of your own.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gymnasium
import torch

from afm_rl.planning import StoredPolicy, load_policy, policy_from_sb3, save_policy

VERSIONS = {"-v3": "-v5", "-v2": "-v3"}  # of the tasks, when they were trained and today


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of a model, such as trpo/Hopper-v3_1")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--episodes", type=int, default=5)
    args = parser.parse_args()
    torch.set_num_threads(1)
    name = args.folder.name.rsplit("_", 1)[0]
    seen = args.folder / name / "vecnormalize.pkl"
    policy = policy_from_sb3(args.folder / f"{name}.zip", seen if seen.is_file() else None)
    task = next((name.replace(*pair) for pair in VERSIONS.items() if pair[0] in name), name)
    # Contact forces were all zero in the simulator of that time: these Ants do not see them.
    settings = {"include_cfrc_ext_in_observation": False} if task.startswith("Ant") else {}
    source = f"DLR-RM/rl-trained-agents, {args.folder.parent.name}/{args.folder.name}, MIT"
    about = {"id": task, "settings": settings, "origin": source}
    env = gymnasium.make(task, **settings)
    policy = first_numbers(policy, env.observation_space.shape[0])
    save_policy(args.out, policy, about)
    results = returns(env, args.out, args.episodes)
    save_policy(args.out, policy, {**about, "return": round(sum(results) / len(results), 1)})
    print(f"{args.out}: returns {', '.join(f'{x:.0f}' for x in results)}")


def first_numbers(policy: StoredPolicy, count: int) -> StoredPolicy:
    """Return the policy of the first ``count`` numbers of an observation.

    What follows were contact forces, which were always zero, and at an odd place at the end the
    share of the episode that is left, here as at its beginning.
    """
    layers = list(zip(policy.weights, policy.biases, strict=True))
    (weight, bias), normaliser, clip = layers[0], policy.normaliser, policy.form["clip"]
    rest = torch.zeros(policy.observation_size - count)
    if len(rest) % 2:
        rest[-1] = 1.0
    if normaliser is not None:
        mean, std = normaliser
        rest, normaliser = (
            ((rest - mean[count:]) / std[count:]).clamp(-clip, clip),
            normaliser[:, :count],
        )
    layers[0] = weight[:, :count], bias + weight[:, count:] @ rest
    return StoredPolicy(layers, policy.low, policy.high, normaliser=normaliser, **policy.form)


def returns(env: gymnasium.Env, file: Path, episodes: int) -> list[float]:
    """Return the returns of a stored policy in the healthy task."""
    (policy, _), totals = load_policy(file), [0.0] * episodes
    for episode in range(episodes):
        observation, _ = env.reset(seed=episode)
        over = False
        while not over:
            action = policy(torch.as_tensor(observation, dtype=torch.float32)).numpy()
            observation, reward, terminated, truncated, _ = env.step(action)
            totals[episode] += float(reward)
            over = terminated or truncated
    return totals


if __name__ == "__main__":
    main()
