"""Models of Stable-Baselines3 and CleanRL act as in their own libraries; nothing in them runs."""

import io
import json
import os
import pickle
import random
import re
import struct
import tracemalloc
import zipfile

import gymnasium
import numpy as np
import pytest
import torch
from harness import mutated
from torch import nn

from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.planning import load_policy, policy_from_cleanrl, policy_from_sb3, save_policy
from afm_rl.storage.torch_files import LARGEST, read_saved

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


WEIGHTS = {
    "mlp_extractor.policy_net.0.weight": torch.ones(8, 3),
    "action_net.weight": torch.ones(1, 8),
}
BOX = {"low": "[-1.]", "high": "[1.]"}


def saved(value, **how):
    content = io.BytesIO()
    torch.save(value, content, **how)
    return content.getvalue()


def zipped(members, **how):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", **how) as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return content.getvalue()


def model(weights=None, **settings):
    """What Stable-Baselines3 writes, as far as it is read; settings may be text instead."""
    text = settings.pop("text", json.dumps({"action_space": BOX, **settings}))
    weights = weights if isinstance(weights, bytes) else saved({**WEIGHTS, **(weights or {})})
    return {"data": text, "policy.pth": weights}


def described(operations):
    """Weights that the operations of a pickle describe."""
    return zipped(archive(operations))


def archive(operations):
    pickled = b"\x80\x02" + operations
    return {"archive/data.pkl": pickled, "archive/version": "3\n", "archive/data/0": bytes(8)}


def encrypted(content):
    """Set the flag of each header of a zip that says so."""
    content = bytearray(content)
    for header, flag in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        for part in re.finditer(header, content):
            content[part.start() + flag] |= 1
    return bytes(content)


def contents(megabytes):
    """A zip that is nothing but its table of contents."""
    entry = b"PK\1\2" + struct.pack("<6H3I5H2I", *[20, 20, *[0] * 7, 1, *[0] * 6]) + b"a"
    listed = entry * (megabytes * 2**20 // len(entry))
    counts = 0, 0, 0xFFFF, 0xFFFF, len(listed), 0, 0
    return listed + b"PK\5\6" + struct.pack("<4H2IH", *counts)


def shrunk(name, members):
    """A zip in which one member is as many zeros as no model has, in little room."""
    return zipped({**members, name: bytes(LARGEST + 1)}, compression=8, compresslevel=1)


LAST, NAN = "action_net.weight", float("nan")
NOISY = {"actor.mu.0.weight": torch.ones(1, 3), "actor.log_std": torch.ones(1)}
PAIRS = b")" + b"q\1h\1\x86" * 100  # a pair of pairs of pairs ...: 2^100 leaves
STORAGE = b"(X\7\0\0\0storagectorch\nFloatStorage\nX\1\0\0\x000X\3\0\0\0cpuK\2tQ"
TENSOR = (
    b"ctorch._utils\n_rebuild_tensor_v2\n("
    + STORAGE
    + b"K\0%b%b\x89ccollections\nOrderedDict\n)RtR"
)
NAMED = b"}X\1\0\0\0a" + TENSOR + b"s."
CALL = b"}X\1\0\0\0ac%b\n%b\nJ\xff\xff\xff\x7f\x85Rs."  # of 2^31 - 1
HOSTILE = {
    "deep": lambda: zipped(model(text="[" * 10**6)),
    "deep and whole": lambda: zipped(model(text="[" * 10**5 + "]" * 10**5)),
    "a list": lambda: zipped(model(text="[1]")),
    "a number": lambda: zipped(model(text="1e999")),
    "settings in a list": lambda: zipped(model(policy_kwargs=[1])),
    "settings as a number": lambda: zipped(model(policy_kwargs=3)),
    "actions in a list": lambda: zipped(model(action_space=[1])),
    "a box of NaN": lambda: zipped(model(action_space={**BOX, "low": "[nan]"})),
    "a box without end": lambda: zipped(model(NOISY, action_space={**BOX, "low": "[-inf]"})),
    "a box upside down": lambda: zipped(model(action_space={**BOX, "low": "[2.]"})),
    "a limit of NaN": lambda: zipped(model(NOISY, policy_kwargs={"clip_mean": NAN})),
    "a limit in words": lambda: zipped(model(NOISY, policy_kwargs={"clip_mean": "x"})),
    "an activation": lambda: zipped(model(policy_kwargs={"activation_fn": "activation.Sin"})),
    "integers": lambda: zipped(model({LAST: torch.ones(1, 8, dtype=torch.int64)})),
    "one number": lambda: zipped(model({LAST: torch.ones(())})),
    "a vector": lambda: zipped(model({LAST: torch.ones(8)})),
    "NaN": lambda: zipped(model({LAST: torch.full((1, 8), NAN)})),
    "too large": lambda: zipped(model({LAST: torch.full((1, 8), 1e300, dtype=torch.float64)})),
    "complex": lambda: zipped(model({LAST: torch.ones(1, 8, dtype=torch.complex64)})),
    "sparse": lambda: zipped(model({LAST: torch.ones(1, 8).to_sparse()})),
    "a long bias": lambda: zipped(model({"action_net.bias": torch.ones(2)})),
    "one number repeated": lambda: zipped(model({LAST: torch.ones(1, 1).expand(1, 10**12)})),
    "no names": lambda: zipped(model(saved([1, 2]))),
    "no tensors": lambda: zipped(model(saved({LAST: 3}))),
    "numbers as names": lambda: zipped(model(saved({1: torch.ones(1)}))),
    "pairs as a name": lambda: zipped(model(described(b"}" + PAIRS + b"K\1s."))),
    "a long text as a size": lambda: zipped(
        model(described(NAMED % (b"(J\xff\xff\xff\x7fX\1\0\0\0at", b")")))
    ),
    "a size below zero": lambda: zipped(
        model(described(NAMED % (b"J\xff\xff\xff\xff\x85", b"K\1\x85")))
    ),
    "a stride too long": lambda: zipped(model(described(NAMED % (b"K\2\x85", b"K\x09\x85")))),
    "a storage of two gigabytes": lambda: zipped(
        model(described(CALL % (b"torch.storage", b"UntypedStorage")))
    ),
    "a tensor larger than its numbers": lambda: zipped(
        model(described(NAMED % (b"J\xff\xff\xff\x7f\x85", b"K\1\x85")))
    ),
    "tuples in tuples": lambda: zipped(model(described(b"})" + b"\x85" * 10**6 + b"K\1s."))),
    "zeros": lambda: shrunk("policy.pth", model()),
    "zeros in the settings": lambda: shrunk("data", model()),
    "zeros in a tensor": lambda: zipped(
        model(shrunk("archive/data/0", archive(NAMED % (b")", b")"))))
    ),
    "contents": lambda: contents(64),
    "encrypted": lambda: encrypted(zipped(model())),
    "an unusual zip": lambda: zipped(model(), compression=zipfile.ZIP_LZMA),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_whatever_a_file_holds_ends_in_one_line_and_little_memory(name, tmp_path):
    file = tmp_path / "model.zip"
    file.write_bytes(HOSTILE[name]())
    size = file.stat().st_size
    tracemalloc.start()
    with pytest.raises((ArtefactError, ConfigurationError)) as refused:
        policy_from_sb3(file)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    message = str(refused.value)
    assert message.startswith(f"{file}: ") and "\n" not in message and len(message) < 1000
    assert most < 2 * size + 10**8


@pytest.mark.parametrize("damaged", ["model", pytest.param("normaliser", marks=pytest.mark.slow)])
def test_600_damaged_files_are_read_or_refused(damaged, tmp_path):
    moments = {"mean": np.zeros(3), "var": np.ones(3)}
    contents = {
        "model": zipped(model()),
        "normaliser": pickle.dumps({"obs_rms": moments, "epsilon": 1e-8, "clip_obs": 10.0}),
    }
    rng, read = random.Random(0), 0
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    for _ in range(600):
        (tmp_path / damaged).write_bytes(mutated(contents[damaged], rng))
        try:
            policy = policy_from_sb3(*(tmp_path / name for name in contents))
        except (ArtefactError, ConfigurationError) as error:
            assert "\n" not in str(error)
        else:
            read += policy(torch.ones(3)).isfinite().all()
    assert 0 < read < 300


def test_nothing_in_a_file_runs(tmp_path):
    bomb = Bomb()
    bomb.folder = str(tmp_path / "harm")
    weights = saved({LAST: bomb})
    (tmp_path / "model.zip").write_bytes(zipped(model(weights)))
    (tmp_path / "seen.pkl").write_bytes(pickle.dumps({"obs_rms": bomb}))
    with pytest.raises(ArtefactError, match="no weights"):
        policy_from_sb3(tmp_path / "model.zip")
    (tmp_path / "sound.zip").write_bytes(zipped(model()))
    with pytest.raises(ArtefactError, match="no mean and variance"):
        policy_from_sb3(tmp_path / "sound.zip", tmp_path / "seen.pkl")
    assert policy_from_sb3(tmp_path / "sound.zip").observation_size == 3
    assert not (tmp_path / "harm").exists()


def test_torch_opens_the_needed_parts_of_an_archive_and_no_others(monkeypatch):
    content, opened = io.BytesIO(saved({LAST: torch.ones(2, 3)})), []
    with zipfile.ZipFile(content, "a") as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("/data.pkl"))
        folder = name.removesuffix("data.pkl")
        for extra in ("code/policy.py", "constants.pkl", "data/0/0", "../data/0"):
            archive.writestr(f"{folder}{extra}", b"not needed")
        archive.writestr("other/data.pkl", b"not needed")
    real = torch.load

    def load(file, **settings):
        with zipfile.ZipFile(file) as archive:
            opened.extend(archive.namelist())
        file.seek(0)
        return real(file, **settings)

    monkeypatch.setattr(torch, "load", load)
    assert torch.equal(read_saved(content.getvalue())[LAST], torch.ones(2, 3))
    assert {f"{folder}data.pkl", f"{folder}data/0"} <= {*opened}
    needed = {"data.pkl", "data/0", "version", "byteorder"}
    assert {name.removeprefix(folder) for name in opened} <= needed


def test_what_torch_before_1_6_wrote_is_refused_with_the_lines_that_convert_it(tmp_path):
    file, box = tmp_path / "agent.pth", gymnasium.spaces.Box(-1.0, 1.0, (1,))
    weights = {"actor_mean.0.weight": torch.ones(1, 3)}
    torch.save(weights, file, _use_new_zipfile_serialization=False)
    with pytest.raises(ArtefactError, match="torch before 1.6 wrote it: ") as refused:
        policy_from_cleanrl(file, box)
    lines = re.search(r"wrote it: (.*)$", str(refused.value))[1]
    exec(lines, {"torch": torch, "FILE": file})
    assert policy_from_cleanrl(file, box)(torch.full((3,), 0.25)) == 0.75


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
    with pytest.raises(ConfigurationError, match="expected layers that fit each other"):
        policy_from_cleanrl(tmp_path / "other.pth", gymnasium.spaces.Box(-1.0, 1.0, (1,)))
