"""Stored policies in the place of a planner: what they see, what they get, what the oracle is."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from harness import agent_of, refused
from torchrl.envs.utils import ExplorationType, set_exploration_type

from afm_rl.envs import gymnasium_task
from afm_rl.missions import run
from afm_rl.planning import StoredPolicy, load_policy, save_policy

POLICIES = Path(__file__).parents[2] / "examples" / "policies"
CHEETAH, PENDULUM = (POLICIES / f"{name}_sac.safetensors" for name in ("half_cheetah", "pendulum"))
RUNNER = ["robot.id=HalfCheetah-v5", f"planner.file={CHEETAH}", "robot.steps=50"]
SWINGER = ["robot.id=Pendulum-v1", f"planner.file={PENDULUM}"]


PLAYED = ("robot=gymnasium", "planner=policy")


def returns_of(*overrides):
    return run(agent_of(*PLAYED, *overrides)).missions["return"].to_numpy()


@pytest.mark.parametrize(
    ("task", "file", "steps"),
    [("HalfCheetah-v5", CHEETAH, 25), ("Pendulum-v1", PENDULUM, 80)],  # rounding grows later
)
def test_a_mission_is_an_episode_of_gymnasium(task, file, steps):
    env, (policy, _) = gymnasium.make(task), load_policy(file)
    (observation, _), total = env.reset(seed=1), 0.0
    for _ in range(steps):
        action = policy(torch.as_tensor(observation, dtype=torch.float32)).numpy()
        observation, reward, *_ = env.step(action)
        total += float(reward)
    settings = [f"robot.id={task}", f"planner.file={file}", f"robot.steps={steps}"]
    found = returns_of(*settings, "method=physics", "regimes=none", "seeds=[1]")
    assert found == pytest.approx(total, rel=1e-3)


@pytest.mark.parametrize(
    ("task", "gap"),
    [("Hopper-v5", 1e-9), ("InvertedDoublePendulum-v5", 1e-9), ("Reacher-v5", 1e-4)],
)  # gymnasium shows the reacher's finger as it was a simulation step before
def test_a_policy_sees_what_the_environment_shows(task, gap):
    env = gymnasium.make(task)
    found = gymnasium_task(task, reward=lambda state, action, after: state[..., 0])
    env.reset(seed=3)
    states, shown = [], []
    for _ in range(4):
        env.action_space.seed(3)
        observation, *_ = env.step(env.action_space.sample())
        data = env.unwrapped.data
        states.append(np.concatenate([data.qpos, data.qvel]))
        shown.append(observation)
    seen = found.observe(torch.tensor(np.stack(states)).reshape(2, 2, -1))
    wanted = torch.tensor(np.stack(shown)).reshape(2, 2, -1)
    torch.testing.assert_close(seen, wanted, atol=gap, rtol=0)


def test_the_oracle_sends_the_action_whose_effect_is_the_policys():
    regimes = [
        "{}",
        "{gain_0: -1, gain_1: -1, gain_2: -1, gain_3: -1, gain_4: -1, gain_5: -1}",
        "{from_0: 3, from_3: 0}",
        "{delay: 1}",
    ]
    changed = [*RUNNER, f"regimes=[{', '.join(regimes)}]", "robot.schedule.at=[]"]
    alone, told = (returns_of(*changed, f"method={name}") for name in ("physics", "oracle"))
    assert told[1:3] == pytest.approx([alone[0]] * 2, rel=1e-2)
    assert (alone[1:3] < 0.5 * alone[0]).all()
    assert told[3] == alone[3]  # a delay cannot be undone


@pytest.mark.slow
def test_a_correction_brings_back_what_a_reversal_takes():
    changed = [*SWINGER, "regimes=[{gain_0: -1}]", "robot.schedule.at=[0.05]", "robot.steps=150"]
    alone, corrected, told = (
        returns_of(*changed, f"method={name}") for name in ("physics", "afm_physics", "oracle")
    )
    assert (alone < -900).all()
    assert corrected == pytest.approx(told, abs=150)


def test_actions_are_noisy_only_while_data_are_collected():
    planner = agent_of(*PLAYED, *SWINGER, "method=physics").planner
    td = agent_of(*PLAYED, *SWINGER, "method=physics").env.reset()
    told = planner(td.clone())["action"]
    assert planner(td.clone())["action"].equal(told)
    with set_exploration_type(ExplorationType.RANDOM):
        assert not planner(td.clone())["action"].equal(told)


def test_a_learned_model_is_that_of_the_policy_whatever_its_file_is_called(tmp_path):
    box = -2 * torch.ones(1), 2 * torch.ones(1)
    found = []
    for scale in (1.0, 2.0):
        policy = StoredPolicy([(scale * torch.eye(1, 3), torch.zeros(1))], *box)
        save_policy(tmp_path / "p.safetensors", policy, {})
        agent = agent_of(
            *PLAYED, f"planner.file={tmp_path / 'p.safetensors'}", "method=afm_frozen_pe"
        )
        found.append(agent.trainings[0].settings)
    assert found[0] != found[1]


@refused(
    ([], "planner.file=None: expected a file"),
    (["planner.file=none.safetensors"], "planner.file: none.safetensors: no such file"),
    ([f"planner.file={CHEETAH}"], "17 observations and 6 actions; the robot has 3 and 1"),
    ([f"planner.file={PENDULUM}", "planner.noise=-1"], "planner.noise=-1"),
)
def test_files_that_do_not_fit_are_refused(settings):
    agent_of(*PLAYED, "robot.id=Pendulum-v1", *settings, "method=physics")
