"""Policies in files are the networks that were stored."""

import pytest
import torch
from torch import nn

from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.planning import StoredPolicy, load_policy, save_policy
from afm_rl.storage.artefacts import save_tensors


@pytest.fixture
def stored(tmp_path):
    torch.manual_seed(0)
    linear = [nn.Linear(3, 8), nn.Linear(8, 8), nn.Linear(8, 2)]
    layers = [(part.weight.half().float(), part.bias.half().float()) for part in linear]
    low, high = torch.tensor([-2.0, 0.0]), torch.tensor([2.0, 1.0])
    policy = StoredPolicy(layers, low, high)
    save_policy(tmp_path / "policy.safetensors", policy, {"id": "Some-v0"})
    return tmp_path / "policy.safetensors", layers


def test_what_comes_back_is_the_network(stored):
    file, layers = stored
    policy, about = load_policy(file)
    seen = torch.randn(7, 3)
    hidden = seen
    for weight, bias in layers[:-1]:
        hidden = (hidden @ weight.T + bias).clamp_min(0)
    unit = (hidden @ layers[-1][0].T + layers[-1][1]).tanh()
    wanted = torch.stack([2 * unit[:, 0], (unit[:, 1] + 1) / 2], -1)
    torch.testing.assert_close(policy(seen), wanted)
    assert about["id"] == "Some-v0" and policy.observation_size == 3
    assert not policy(seen).requires_grad


def test_types_follow_the_observation(stored):
    policy, _ = load_policy(stored[0])
    assert policy(torch.zeros(3, dtype=torch.float64)).dtype == torch.float64


def test_files_that_hold_no_policy_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="no such file"):
        load_policy(tmp_path / "nothing.safetensors")
    save_tensors(tmp_path / "other.safetensors", {"a": torch.zeros(1)}, {})
    with pytest.raises(ArtefactError, match="contains no policy"):
        load_policy(tmp_path / "other.safetensors")


BOX = {"low": -torch.ones(1), "high": torch.ones(1)}
SOUND = {"weights.0": torch.ones(1, 3), "biases.0": torch.zeros(1), **BOX}


@pytest.mark.parametrize(
    ("tensors", "form"),
    [
        ({}, [1]),
        ({}, {"colour": "red"}),
        ({}, {"limit": "far"}),
        ({}, {"clip": float("nan")}),
        ({}, {"activation": ["relu"]}),
        ({"low": None}, {}),
        ({"biases.0": None}, {}),
        ({"biases.0": torch.zeros(2)}, {}),
        ({"weights.0": torch.ones(())}, {}),
        ({"weights.0": torch.ones(1, 3, dtype=torch.int64)}, {}),
        ({"weights.0": torch.full((1, 3), 1e300, dtype=torch.float64)}, {}),
        ({"high": -2 * torch.ones(1)}, {}),
        ({"normaliser": torch.ones(2, 4)}, {}),
        ({"normaliser": torch.zeros(2, 3)}, {}),
    ],
)
def test_files_of_others_are_refused_in_one_line(tensors, form, tmp_path):
    file = tmp_path / "mine.safetensors"
    held = {name: value for name, value in {**SOUND, **tensors}.items() if value is not None}
    save_tensors(file, held, {"kind": "policy", "form": form})
    with pytest.raises((ArtefactError, ConfigurationError)) as refused:
        load_policy(file)
    assert "\n" not in str(refused.value)
