"""Swing up gymnasium's pendulum with MPPI and a model that is written down.

    python examples/plan/pendulum.py

A planner is a policy: it fits wherever TorchRL takes one. `ICEM` and `CEM` in place of `MPPI` do
the same.
"""

import argparse

import torch
from torchrl.envs import GymEnv, TransformedEnv

from afm_rl.dynamics import KnownDynamics
from afm_rl.planning import MPPI, KnownReward, PlanningEnv
from afm_rl.spaces.manifold import Manifold


def swing(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """One step (0.05 s) of Pendulum-v1; the state is (cos, sin, speed)."""
    cos, sin, speed = state.unbind(-1)
    speed = (speed + 0.05 * (15.0 * sin + 3.0 * action[..., 0])).clamp(-8.0, 8.0)
    angle = torch.atan2(sin, cos) + 0.05 * speed
    return torch.stack([angle.cos(), angle.sin(), speed], -1)


def upright(state: torch.Tensor, action: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
    """Its reward, for the state that an action leads to."""
    angle = torch.atan2(after[..., 1], after[..., 0])
    return -(angle**2 + 0.1 * after[..., 2] ** 2 + 0.001 * action[..., 0] ** 2)


parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--steps", type=int, default=150)
asked = parser.parse_args()

torch.set_num_threads(1)
env = GymEnv("Pendulum-v1")
env.set_seed(0)
space = env.action_spec.space
model = KnownDynamics(swing, Manifold(3), action_size=1)
world = PlanningEnv(model, KnownReward(upright), space.low, space.high)
planner = MPPI(world, horizon=20, population=200, temperature=1.0)
data = TransformedEnv(env, planner.make_tensordict_primer()).rollout(asked.steps, planner)
angles = torch.atan2(data["next", "observation"][:, 1], data["next", "observation"][:, 0])
for step in range(0, asked.steps, 10):
    print(f"step {step:3d}  angle {angles[step].item():+.2f} rad from upright")
