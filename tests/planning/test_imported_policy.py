"""Models of Stable-Baselines3 and CleanRL act as in their own libraries; nothing in them runs."""

import io
import os
import pickle
import zipfile

import gymnasium
import numpy as np
import pytest
import torch
from torch import nn

from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.planning import load_policy, policy_from_cleanrl, policy_from_sb3, save_policy

SEEN = np.random.default_rng(0).uniform(-1, 1, (16, 3)).astype(np.float32) * [1, 1, 8]
SMALL = {"net_arch": [8, 8]}


def of_sb3(kind, **settings):
    sb3 = pytest.importorskip("stable_baselines3")
    env = settings.pop("env", "Pendulum-v1")
    return getattr(sb3, kind)("MlpPolicy", env, policy_kwargs=dict(SMALL), device="cpu", **settings)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("PPO", {}),
        ("A2C", {"use_sde": True}),
        ("SAC", {"buffer_size": 10}),
        ("SAC", {"buffer_size": 10, "use_sde": True}),
        ("TD3", {"buffer_size": 10}),
    ],
)
def test_a_model_acts_as_it_did(kind, settings, tmp_path):
    model = of_sb3(kind, **settings)
    for value in model.policy.parameters():  # large, so that limits matter
        value.data *= 5 if value.dim() < 2 or value.shape[0] > 1 else 100
    model.save(tmp_path / "model.zip")
    policy = policy_from_sb3(tmp_path / "model.zip")
    wanted, _ = model.predict(SEEN, deterministic=True)
    found = policy(torch.from_numpy(SEEN).float()).numpy()
    np.testing.assert_allclose(found, wanted, atol=1e-5)
    assert np.abs(wanted).max() > 1


@pytest.mark.filterwarnings("ignore")
def test_observations_are_normalised_as_they_were(tmp_path):
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    env = VecNormalize(DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")]), clip_obs=1.5)
    env.obs_rms.update(SEEN)
    model = of_sb3("PPO", env=env)
    model.save(tmp_path / "model.zip")
    env.save(tmp_path / "seen.pkl")
    policy = policy_from_sb3(tmp_path / "model.zip", tmp_path / "seen.pkl")
    wanted, _ = model.predict(env.normalize_obs(SEEN), deterministic=True)
    save_policy(tmp_path / "stored.safetensors", policy, {})
    for each, error in ((policy, 1e-5), (load_policy(tmp_path / "stored.safetensors")[0], 1e-2)):
        found = each(torch.from_numpy(SEEN)).numpy()
        np.testing.assert_allclose(found, wanted, atol=error)


class Actor(nn.Module):
    """What CleanRL calls the parts of its SAC."""

    def __init__(self):
        super().__init__()
        self.fc1, self.fc2, self.fc_mean = nn.Linear(3, 8), nn.Linear(8, 8), nn.Linear(8, 1)
        self.register_buffer("action_scale", torch.tensor([2.0]))

    def forward(self, seen):
        hidden = self.fc2(self.fc1(seen).relu()).relu()
        return 2 * self.fc_mean(hidden).tanh()


def test_cleanrl(tmp_path):
    torch.manual_seed(0)
    space, seen = gymnasium.spaces.Box(-2.0, 2.0, (1,)), torch.from_numpy(SEEN).float()
    actor, mean = Actor(), nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 1))
    torch.save(actor.state_dict(), tmp_path / "sac.cleanrl_model")
    policy = policy_from_cleanrl(tmp_path / "sac.cleanrl_model", space)
    torch.testing.assert_close(policy(seen), actor(seen))
    named = {f"actor_mean.{name}": value for name, value in mean.state_dict().items()}
    torch.save({**named, "critic.0.weight": torch.ones(1, 3)}, tmp_path / "ppo.cleanrl_model")
    policy = policy_from_cleanrl(tmp_path / "ppo.cleanrl_model", space)
    torch.testing.assert_close(policy(seen), mean(seen).clamp(-2, 2))


class Bomb:
    """Runs when it is unpickled."""

    def __reduce__(self):
        return os.mkdir, (self.folder,)


def test_nothing_in_a_file_runs(tmp_path):
    bomb, content = Bomb(), io.BytesIO()
    bomb.folder = str(tmp_path / "harm")
    torch.save({"action_net.weight": bomb}, content)
    box = {"low": "[-1.]", "high": "[1.]"}
    with zipfile.ZipFile(tmp_path / "model.zip", "w") as archive:
        archive.writestr("data", f'{{"action_space": {box}}}'.replace("'", '"'))
        archive.writestr("policy.pth", content.getvalue())
    (tmp_path / "seen.pkl").write_bytes(pickle.dumps({"obs_rms": bomb}))
    with pytest.raises(ArtefactError, match="no weights"):
        policy_from_sb3(tmp_path / "model.zip")
    torch.save({"action_net.weight": torch.ones(1, 3)}, tmp_path / "weights.pth")
    with zipfile.ZipFile(tmp_path / "sound.zip", "w") as archive:
        archive.writestr("data", f'{{"action_space": {box}}}'.replace("'", '"'))
        archive.write(tmp_path / "weights.pth", "policy.pth")
    with pytest.raises(ArtefactError, match="no mean and variance"):
        policy_from_sb3(tmp_path / "sound.zip", tmp_path / "seen.pkl")
    assert policy_from_sb3(tmp_path / "sound.zip").observation_size == 3
    assert not (tmp_path / "harm").exists()


def test_files_that_hold_no_policy_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="no such file"):
        policy_from_sb3(tmp_path / "nothing.zip")
    (tmp_path / "other.zip").write_bytes(b"no zip")
    with pytest.raises(ArtefactError, match="no model of Stable-Baselines3"):
        policy_from_sb3(tmp_path / "other.zip")
    torch.save({"cnn.0.weight": torch.ones(1, 3)}, tmp_path / "other.pth")
    with pytest.raises(ArtefactError, match="no actor of a known kind"):
        policy_from_cleanrl(tmp_path / "other.pth", gymnasium.spaces.Box(-1.0, 1.0, (1,)))
    torch.save({"actor_mean.0.weight": torch.ones(2, 3)}, tmp_path / "other.pth")
    with pytest.raises(ConfigurationError, match="feeds the next"):
        policy_from_cleanrl(tmp_path / "other.pth", gymnasium.spaces.Box(-1.0, 1.0, (1,)))
