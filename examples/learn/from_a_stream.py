"""Let an ensemble learn from every step of a robot whose motors are reversed.

    python examples/learn/from_a_stream.py

A collector drives, the updater learns from what was driven, and the planner that shares the model
plans better. Transitions are used once and then forgotten: no replay buffer.
"""

import argparse

import torch
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from afm_rl.dynamics import Dubins, Ensemble
from afm_rl.envs import UGVTrack
from afm_rl.learning import (
    GaussianNLLLoss,
    OnlineUpdater,
    ResetAdam,
    UpdaterHook,
    pretrain_ensemble,
)
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
from afm_rl.regimes import Schedule
from afm_rl.spaces.manifold import Manifold

ROBOTS, STEPS = 4, 25  # at once, and per batch

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--batches", type=int, default=12, help=f"of {STEPS} steps")
parser.add_argument("--samples", type=int, default=10_000, help="to pre-train with")
asked = parser.parse_args()

torch.set_num_threads(1)
reversed_motors = {"schedule": Schedule([]), "missions": {"regime": {"v_gain": -1.0}}}
env = UGVTrack(batch_size=(ROBOTS,), **reversed_motors)
box = env.action_spec_unbatched.space
low, high = box.low, box.high
states = torch.tensor([0.0, 0.0, -3.14]), torch.tensor([0.0, 0.0, 3.14])
model = Ensemble(Manifold(3, angles=[2]), 2, features=[2], members=3, hidden=[64, 64])
pretrain_ensemble(model, Dubins(), states, (low, high), samples=asked.samples)

planner = MPPI(PlanningEnv(model, GoalDistance(), low, high), candidates=100)
env = TransformedEnv(env, planner.make_tensordict_primer())
updater = OnlineUpdater(GaussianNLLLoss(model), lambda parameters: ResetAdam(parameters, lr=1e-3))
frames = ROBOTS * STEPS
collector = Collector(
    env,
    planner,
    frames_per_batch=frames,
    total_frames=frames * asked.batches,
    postproc=UpdaterHook(updater),
)
for count, batch in enumerate(collector):
    thought = model(torch.zeros(3), torch.tensor([1.0, 0.0]))[0]
    loss = batch["updater_loss"].mean()
    print(f"batch {count:2d}  loss {loss:6.2f}  full speed is thought to drive {thought:+.2f} m")
print("in truth it drives -0.20 m")
collector.shutdown()
