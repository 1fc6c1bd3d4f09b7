"""Planner and action flow matching as one policy: a state goes in, an action comes out.

    python examples/deploy/control_loop.py

The loop is that of a robot, not of an environment: read the state, ask the policy, send the action.
Half-way the motors are reversed. At the end the time that an action took is printed.
"""

import argparse
import time

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs import Compose
from torchrl.envs.utils import step_mdp

from afm_rl.dynamics import Dubins
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
from afm_rl.regimes import ActionGain
from afm_rl.transforms import ActionFlowPolicy

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--steps", type=int, default=200)
asked = parser.parse_args()

torch.set_num_threads(1)
torch.manual_seed(0)
model, gains = Dubins(), ActionGain(["v", "omega"])
low, high = torch.tensor([-1.0, -1.57]), torch.tensor([1.0, 1.57])
planner = MPPI(PlanningEnv(model, GoalDistance(), low, high))
policy = TensorDictSequential(planner, ActionFlowPolicy(model, planner.action_spec))

pose, seconds = torch.zeros(3), []  # the robot
td = Compose(*(part.make_tensordict_primer() for part in policy))(TensorDict({}))
for step in range(asked.steps):
    regime = gains.encode({"v": -1.0} if step >= asked.steps // 2 else {})
    angle = torch.tensor(0.05 * step)
    td["observation"], td["goal"] = pose, 3.0 * torch.stack([angle.cos(), angle.sin()])

    begun = time.perf_counter()
    td = policy(td)
    seconds.append(time.perf_counter() - begun)

    pose = model(pose, gains.apply(td["action"], regime, pose))
    if step % (asked.steps // 10) == 0:
        planned = td["next", "afm", "planned_action"]
        print(
            f"step {step:3d}  planned {planned[0]:+.2f} m/s  executed {td['action'][0]:+.2f} m/s  "
            f"{(pose[:2] - td['goal']).norm():.2f} m from the goal"
        )
    td = step_mdp(td)
spent = 1e3 * torch.tensor(seconds[5:])  # the first ones warm up
print(f"an action takes {spent.median():.1f} ms, in one of a hundred {spent.quantile(0.99):.1f} ms")
