"""Collecting transitions from environments that are not ours."""

import torch
from torchrl.envs import GymEnv, SerialEnv, TransformedEnv

from afm_rl.dynamics import Ensemble
from afm_rl.learning import collect
from afm_rl.planning import MPPI, KnownReward, PlanningEnv
from afm_rl.spaces.manifold import Manifold


def pendulum(steps=200):
    return GymEnv("Pendulum-v1", max_episode_steps=steps)


def test_random_actions_fill_a_replay_buffer():
    buffer = collect(pendulum(), frames=30)
    data = buffer[:]
    assert len(data) == 30 and data["action"].abs().max() <= 2.0 and data["action"].std() > 0.5
    assert set(data.keys()) >= {"observation", "action", "next"}
    assert buffer.sample()["next", "reward"].shape == (30, 1)


def test_frames_are_rounded_up_to_whole_steps_of_the_batch():
    assert len(collect(SerialEnv(4, pendulum), frames=30)) == 32


def test_episodes_that_end_keep_their_true_last_state():
    data = collect(pendulum(steps=5), frames=15)[:]
    assert data["next", "done"].flatten().tolist() == ([False] * 4 + [True]) * 3
    speed = (data["next", "observation"] - data["observation"])[:, 2].abs()
    assert speed.max() < 1.3  # rad/s: gravity and torque can do no more in a step
    torch.testing.assert_close(data["observation"][1:5], data["next", "observation"][:4])


def test_a_planner_over_a_learned_model_can_be_the_policy():
    model = Ensemble(Manifold(3), 1, features=range(3), members=2, hidden=[8])
    reward = KnownReward(lambda state, action, after: after[..., 0])
    planner = MPPI(PlanningEnv(model, reward, [-2.0], [2.0]), horizon=3, candidates=8)
    twin = MPPI(PlanningEnv(model, reward, [-2.0], [2.0]), horizon=3, candidates=8)
    env = TransformedEnv(SerialEnv(2, pendulum), planner.make_tensordict_primer())
    data = collect(env, planner, frames=12, seed=5)[:].reshape(2, 6)
    env.set_seed(5)
    expected = env.rollout(6, twin)["action"]
    torch.testing.assert_close(data["action"], expected)  # nobody else drew from its noise
    assert not env.is_closed
