"""Importing and running a correction loads nothing that it does not need."""

import subprocess
import sys

import pytest

from afm_rl.imports import RUN

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
corrected = env.rollout(20)["next", "afm", "corrected"].sum()
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
    corrected += info["afm"]["corrected"]
"""
LOADED = """
import sys
assert corrected > 0
print(*(name for name in sys.modules if name.startswith("afm_rl.")))
"""
BEYOND = {
    "diagnosis",
    "jobs",
    "learning",
    "missions",
    "planning",
    "report",
    "cli",
    "play",
    "comparison",
}


BARE = f"""
import sys
sys.modules |= dict.fromkeys({RUN})  # as if these were not installed
"""
BUILDS = """
from hydra import compose, initialize_config_module
from afm_rl.missions import build
from afm_rl.errors import ConfigurationError
from afm_rl.missions import run
with initialize_config_module("afm_rl.conf", version_base="1.3"):
    agents = [build(compose("config", [f"method={name}"])) for name in ("afm_physics", "online_pe")]
    agents += [build(compose("config", ["robot=inverted_pendulum", "method=afm_physics"]))]
try:
    run(agents[0])
except ConfigurationError as error:
    print(error)
"""
COMMANDS = """
from importlib import import_module
CALLS = {"": "method=physics", ".compare": "Hopper-v5", ".diagnose": "log.csv", ".report": "folder"}
for module, word in CALLS.items():
    sys.argv[1:] = [word]
    try:
        import_module(f"afm_rl.cli{module}").main()
    except SystemExit as end:
        assert end.code == 2
"""


def output_of(program):
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


@pytest.mark.slow
def test_an_agent_is_built_without_the_extra_run_which_missions_need():
    line = output_of(BARE + BUILDS).strip()
    assert line == "missions: needs the package pandas: pip install 'afm-rl[run]'"


@pytest.mark.check
def test_commands_without_the_extra_run_say_how_to_install_it():
    ran = subprocess.run([sys.executable, "-c", BARE + COMMANDS], capture_output=True, text=True)
    said = ran.stderr.splitlines()
    assert ran.returncode == 0 and len(said) == 4, ran.stderr
    words = f"needs the packages {', '.join(RUN)}: pip install 'afm-rl[run]'"
    assert all(line.endswith(words) for line in said)


@pytest.mark.parametrize(
    "program",
    [
        pytest.param(TRANSFORM, id="transform", marks=pytest.mark.check),
        pytest.param(WRAPPER, id="wrapper", marks=pytest.mark.slow),
    ],
)
def test_a_correction_needs_and_loads_no_planner_learner_diagnosis_or_report(program):
    """Nor any package of the extra run."""
    loaded = output_of(BARE + program + LOADED).split()
    assert {name.split(".")[1] for name in loaded}.isdisjoint(BEYOND)
    assert "afm_rl.correction.action_flow" in loaded
    assert "afm_rl.transforms.record" not in loaded  # nothing is recorded


def test_a_diagnosis_needs_no_torch():
    code = "from afm_rl.diagnosis import Log, diagnose; import numpy as np, sys\n"
    code += "u = np.random.default_rng(0).uniform(-1, 1, (100, 1))\n"
    code += "diagnose(Log(('pan',), u, -u)); assert 'torch' not in sys.modules"
    output_of(code)
