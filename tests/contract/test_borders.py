"""Which rooms of the house the transform and the wrapper enter: none that they do not need."""

import subprocess
import sys

import pytest

BEYOND = (
    "diagnosis",
    "jobs",
    "learning",
    "missions",
    "planning",
    "report",
    "replay",
    "cli",
    "play",
)
TRANSFORM = """
import torch
from torchrl.envs import GymEnv, TransformedEnv
from afm_rl.dynamics import KnownDynamics
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform

def step(state, action):
    th, w = torch.atan2(state[..., 1], state[..., 0]), state[..., 2]
    w = (w + 0.05 * (15 * th.sin() - 3 * action[..., 0].clamp(-2, 2))).clamp(-8, 8)  # reversed
    th = th + 0.05 * w
    return torch.stack([th.cos(), th.sin(), w], -1)

model = KnownDynamics(step, Manifold(3), 1)
env = TransformedEnv(GymEnv("Pendulum-v1"), ActionFlowTransform(model))
torch.manual_seed(0)
corrected = env.rollout(50)["next", "afm", "misaligned"].sum()
"""
WRAPPER = """
import gymnasium
from afm_rl import ActionFlowWrapper

class Reversed(gymnasium.ActionWrapper):
    def action(self, action):
        return -action

env = ActionFlowWrapper(Reversed(gymnasium.make("InvertedPendulum-v5")), model="mujoco")
env.action_space.seed(0)
env.reset(seed=0)
corrected = 0
for _ in range(50):
    _, _, ended, _, info = env.step(env.action_space.sample())
    corrected += info["afm"]["corrects"]
    if ended:
        env.reset()
"""
LOADED = """
import sys
assert corrected > 0
print(*sorted(name for name in sys.modules if name.startswith("afm_rl.")))
"""


@pytest.mark.parametrize("code", [TRANSFORM, WRAPPER], ids=["transform", "wrapper"])
def test_a_correction_loads_what_it_needs_and_nothing_else(code):
    ran = subprocess.run([sys.executable, "-c", code + LOADED], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    rooms = {name.split(".")[1] for name in ran.stdout.split()}
    assert rooms.isdisjoint(BEYOND), sorted(rooms)


def test_a_diagnosis_needs_no_torch():
    code = "from afm_rl.diagnosis import Log, diagnose; import numpy as np, sys\n"
    code += (
        "u = np.random.default_rng(0).uniform(-1, 1, (100, 1)); diagnose(Log(('pan',), u, -u))\n"
    )
    code += "assert 'torch' not in sys.modules"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
