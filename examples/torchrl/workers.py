"""Correct robots in worker processes: a correction in each worker, or one around all.

    python examples/torchrl/workers.py

A model that does not learn may be in either place. The steps are the same.
"""

import argparse
from functools import partial

import torch
from swing_up import correction, make_env
from torchrl.envs import GymEnv, ParallelEnv, TransformedEnv


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--robots", type=int, default=2)
    parser.add_argument("--start", default="spawn", help="how processes start: spawn or fork")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    how = {"mp_start_method": asked.start}
    bare = ParallelEnv(asked.robots, partial(GymEnv, "Pendulum-v1"), **how)
    robots = {
        "inside": ParallelEnv(asked.robots, make_env, **how),
        "around": TransformedEnv(bare, correction(gain=-1.0)),
    }
    found = {}
    for place, env in robots.items():
        torch.manual_seed(0)
        env.set_seed(0)
        found[place] = data = env.rollout(asked.steps, break_when_any_done=False)
        env.close()
        share = data["next", "afm", "corrected"].float().mean()
        print(f"{place} the workers: {tuple(data.shape)} steps, {share:.0%} of them corrected")
    executed = [data["next", "afm", "executed_action"] for data in found.values()]
    print(f"executed actions differ by {(executed[0] - executed[1]).abs().max():.0e} at most")


if __name__ == "__main__":
    main()
