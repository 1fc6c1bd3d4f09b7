"""Put Action Flow Matching into an environment that is not ours.

    python examples/transform/your_env.py

A cart on a line from gymnasium (MountainCarContinuous) whose motor is reversed half-way. Its
nominal dynamics are written down in three lines; everything else is the library, and nothing is
trained.
"""

import torch
from torchrl.envs import GymEnv, TransformedEnv

from afm_rl.dynamics import KnownDynamics
from afm_rl.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform


def hill(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """Position (m) and velocity (m/step) of the cart after one step of gymnasium's own task."""
    position, velocity = state.unbind(-1)
    velocity = velocity + 0.0015 * action[..., 0] - 0.0025 * torch.cos(3 * position)
    return torch.stack([position + velocity, velocity], -1)


torch.set_num_threads(1)
torch.manual_seed(0)
model = KnownDynamics(hill, Manifold(2), action_size=1, noise_std=1e-5)
env = TransformedEnv(GymEnv("MountainCarContinuous-v0"), ActionFlowTransform(model))
td = env.reset(seed=0)
for step in range(40):
    td["action"] = torch.tensor([0.5]) if step % 4 < 2 else torch.tensor([-0.5])
    if step >= 20:  # the motor is reversed below the transform, which is not told
        env.base_env._env.unwrapped.power = -0.0015
    td = env.step(td)
    if step in (10, 19, 21, 30, 39):
        moved = td["next", "observation"][1] - td["observation"][1]
        print(
            f"step {step:2d}  planned {float(td['action']):+.2f}  "
            f"executed {float(td['next', 'afm', 'executed_action']):+.2f}  "
            f"misaligned {bool(td['next', 'afm', 'misaligned'])!s:5}  "
            f"change of velocity {float(moved):+.5f}"
        )
    td = td["next"].exclude("reward")
