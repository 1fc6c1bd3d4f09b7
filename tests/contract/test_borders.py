"""Importing and running a correction loads nothing that it does not need."""

import subprocess
import sys

import pytest

TRANSFORM = """
import torch
from torchrl.envs import GymEnv, TransformedEnv
from afm_rl.dynamics import KnownDynamics
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform

def dynamics(state, action):
    angle, rate = torch.atan2(state[..., 1], state[..., 0]), state[..., 2]
    rate = (rate + 0.05 * (15 * angle.sin() - 3 * action[..., 0].clamp(-2, 2))).clamp(-8, 8)
    angle = angle + 0.05 * rate
    return torch.stack([angle.cos(), angle.sin(), rate], -1)

model = KnownDynamics(dynamics, Manifold(3), 1)  # the torque of the environment is reversed
env = TransformedEnv(GymEnv("Pendulum-v1"), ActionFlowTransform(model))
torch.manual_seed(0)
corrected = env.rollout(50)["next", "afm", "misaligned"].sum()
"""
WRAPPER = """
import gymnasium
from afm_rl import ActionFlowWrapper, FaultWrapper
env = ActionFlowWrapper(FaultWrapper(gymnasium.make("Swimmer-v5"), "all reversed"), model="mujoco")
env.action_space.seed(0)
env.reset(seed=0)
corrected = 0
for _ in range(50):
    *_, info = env.step(env.action_space.sample())
    corrected += info["afm"]["corrects"]
"""
LOADED = """
import sys
assert corrected > 0
print(*(name for name in sys.modules if name.startswith("afm_rl.")))
"""
BEYOND = {"diagnosis", "jobs", "learning", "missions", "planning", "report", "cli", "play"}


def output_of(program):
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


@pytest.mark.parametrize("program", [TRANSFORM, WRAPPER], ids=["transform", "wrapper"])
def test_a_correction_loads_no_planner_learner_diagnosis_or_report(program):
    loaded = output_of(program + LOADED).split()
    assert {name.split(".")[1] for name in loaded}.isdisjoint(BEYOND)
    assert "afm_rl.correction.action_flow" in loaded
    assert "afm_rl.transforms.record" not in loaded  # nothing is recorded


def test_a_diagnosis_needs_no_torch():
    code = "from afm_rl.diagnosis import Log, diagnose; import numpy as np, sys\n"
    code += "u = np.random.default_rng(0).uniform(-1, 1, (100, 1))\n"
    code += "diagnose(Log(('pan',), u, -u)); assert 'torch' not in sys.modules"
    output_of(code)
