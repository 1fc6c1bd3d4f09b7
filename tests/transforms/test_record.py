"""Planned, executed and effective actions as a log that a diagnosis reads as it is."""

import multiprocessing
import os
import signal
import sys

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium.spaces import Box
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from afm_rl.cli import diagnose as command
from afm_rl.diagnosis import diagnose
from afm_rl.diagnosis.readers import read_log
from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError
from afm_rl.planning import GoalDistance, PlanningEnv
from afm_rl.regimes import ActionGain
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform, CorrectionLoop, RegimeTransform
from afm_rl.transforms.controller import Controller
from afm_rl.transforms.gymnasium import ActionFlowVectorWrapper, ActionFlowWrapper

LOW, HIGH = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])
SPEC = Bounded(LOW, HIGH)
STEPS = 60
TRUE = torch.tensor([-0.5, 1.0])  # the gains of the robot


class Cart(gymnasium.Env):
    """A robot that is driven with gains that the model does not know."""

    metadata = {"autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP}  # noqa: RUF012
    action_space = Box(LOW.numpy(), HIGH.numpy())
    observation_space = Box(-np.inf, np.inf, (3,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.left = torch.tensor(self.np_random.uniform(-1, 1, 3)).float(), STEPS // 2
        return self.state.numpy(), {}

    def step(self, action):
        self.state = Dubins()(self.state, TRUE * torch.as_tensor(action))
        self.left -= 1
        return self.state.numpy(), 0.0, self.left == 0, False, {}


def plans(*batch):
    return LOW + (HIGH - LOW) * torch.rand(STEPS, *batch, 2, generator=torch.manual_seed(0))


def with_the_wrapper(file):
    env = ActionFlowWrapper(Cart(), Dubins(), record=file)
    env.reset(seed=0)
    for plan in plans():
        if env.step(plan.numpy())[2]:
            env.reset()


def with_the_vector(file):
    envs = gymnasium.vector.SyncVectorEnv([Cart, Cart])
    envs = ActionFlowVectorWrapper(envs, Dubins(), record=file)
    envs.reset(seed=0)
    for plan in plans(2):
        envs.step(plan.numpy())


def with_the_transform(file):
    world = PlanningEnv(Dubins(), GoalDistance(), LOW, HIGH)
    gains = ActionGain(["v_gain", "omega_gain"])
    robot = TransformedEnv(world, RegimeTransform(gains, [{"v_gain": -0.5}]))
    env = TransformedEnv(robot, ActionFlowTransform(Dubins(), record=file))
    for _ in range(2):
        env.rollout(STEPS // 2)


def with_the_policy(file):
    policy, state = ActionFlowPolicy(Dubins(), SPEC, record=file), torch.zeros(3)
    td = policy.make_tensordict_primer()(TensorDict({"observation": state}))
    arrival = policy.arrival()
    for plan in plans():
        policy(arrival(td).set("action", plan))
        state = Dubins()(td["observation"], TRUE * td["action"])
        td = step_mdp(td.set(("next", "observation"), state))


WAYS = {
    "wrapper": (with_the_wrapper, 2),
    "vector": (with_the_vector, 4),
    "transform": (with_the_transform, 2),
    "policy": (with_the_policy, 1),
}


@pytest.mark.parametrize(("way", "episodes"), WAYS.values(), ids=WAYS)
def test_what_is_recorded_is_a_log(tmp_path, way, episodes, monkeypatch, capsys):
    way(tmp_path / "drive" / "log.csv")
    table = pd.read_csv(tmp_path / "drive" / "log.csv")
    kinds = ("planned", "command", "effective")
    names = [f"{kind}.{k}" for kind in kinds for k in range(2)]
    assert list(table)[-9:] == [*names, "state.0", "state.1", "state.2"]
    assert len(table) >= STEPS - 1 and not table.isna().any().any()
    log = read_log(tmp_path / "drive" / "log.csv")
    assert log.computed and log.begins.sum() == episodes
    np.testing.assert_allclose(log.response, log.command * TRUE.numpy(), atol=1e-3)
    assert not np.allclose(table["planned.0"], table["command.0"])  # it was corrected
    assert str(diagnose(log)).splitlines() == ["0: reversed, 50 % of the command", "1: healthy"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["afm-rl-diagnose", "drive/log.csv", "--no-page"])
    command.main()
    assert "0: reversed, 50 % of the command" in capsys.readouterr().out


def drive_and_die(file):
    loop = CorrectionLoop("robot", record=file).complete(Dubins(), SPEC)
    state = torch.zeros(3)
    memory = loop.begin(state, SPEC)["memory"]
    for plan in plans():
        entries = loop.act(memory, plan, SPEC)
        state = Dubins()(state, entries["executed_action"])
        memory = loop.observe(entries["memory"], state)
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_file_is_whole_after_a_kill(tmp_path):
    process = multiprocessing.get_context("fork").Process(
        target=drive_and_die, args=(tmp_path / "log.csv",)
    )
    process.start()
    process.join(60)
    assert process.exitcode == -signal.SIGKILL
    assert len(read_log(tmp_path / "log.csv").command) == STEPS
    assert (tmp_path / "log.csv").read_bytes().endswith(b"\n")


def test_files_that_cannot_be_used(tmp_path):
    (tmp_path / "log.csv").write_text("mine")
    with pytest.raises(ConfigurationError, match=r"log\.csv'?: is there already; expected a new"):
        CorrectionLoop("robot", record=tmp_path / "log.csv")
    with pytest.raises(ConfigurationError, match=r"expected a file \.csv"):
        CorrectionLoop("robot", record="log.parquet")
    with pytest.raises(ConfigurationError, match="cannot be written"):
        with_the_policy(tmp_path / "log.csv" / "log.csv")
    assert (tmp_path / "log.csv").read_text() == "mine"


def test_a_controller_records_nothing(tmp_path):
    with pytest.raises(ConfigurationError, match="record"):
        Controller(None, ActionFlowPolicy(Dubins(), SPEC, record=tmp_path / "log.csv"))
    assert not list(tmp_path.iterdir())
