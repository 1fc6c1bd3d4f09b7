"""Stored models are whole and fit, or they are refused."""

import json
import os
import random

import pytest
import torch
from harness import same_weights
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import nn

from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.storage.artefacts import Checkpoints, cached, load_artefact, save_artefact
from afm_rl.storage.files import write_whole

MADE_FOR = {"name": "net", "sizes": [3, 2], "rate": 0.1, "of": {"robot": "ugv"}}


def net(outputs=2, seed=0):
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.Linear(4, outputs))


@pytest.fixture
def stored(tmp_path):
    path = tmp_path / "net.safetensors"
    save_artefact(path, net(), MADE_FOR)
    return path


def refuses(path, match=None, description=MADE_FOR, module=None):
    module = module or net(seed=1)
    before = {name: value.clone() for name, value in module.state_dict().items()}
    with pytest.raises(ArtefactError, match=match) as caught:
        load_artefact(path, module, description)
    assert str(path) in str(caught.value)
    for name, value in module.state_dict().items():
        assert torch.equal(value, before[name])


def test_a_module_comes_back_as_it_was(stored):
    module = net(seed=1)
    load_artefact(str(stored), module, {"name": "net"})
    assert same_weights(module, net())


def test_any_flipped_bit_is_noticed(stored):
    whole = stored.read_bytes()
    dice = random.Random(0)
    for _ in range(100):
        position, bit = dice.randrange(len(whole)), dice.randrange(8)
        damaged = bytearray(whole)
        damaged[position] ^= 1 << bit
        stored.write_bytes(damaged)
        refuses(stored)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigurationError, match="nowhere.safetensors: no such file"):
        load_artefact(tmp_path / "nowhere.safetensors", net(), {})


@pytest.mark.parametrize("edit", [{"rate": 0.2}, {"of": {"robot": "quadrotor"}}, {"extra": 1}])
def test_a_file_made_for_something_else_is_refused(stored, edit):
    refuses(stored, next(iter(edit)), {**MADE_FOR, **edit})


def test_a_file_that_fits_another_module_is_refused(stored):
    refuses(stored, r"does not fit: .* size mismatch for 2\.weight", module=net(outputs=5))
    refuses(stored, r"does not fit: .* Unexpected key\(s\)", module=nn.Linear(3, 4))


def described(path, **entries):
    """Return a file's metadata with another description."""
    with safe_open(path, framework="pt") as file:
        return file.metadata() | {"description": json.dumps({**MADE_FOR, **entries})}


def turned(tensors):
    return tensors | {"0.bias": tensors["1.bias"], "1.bias": tensors["0.bias"]}


SPOILT = {
    "nothing": (lambda path: path.write_bytes(b""), "damaged"),
    "cut": (lambda path: path.write_bytes(path.read_bytes()[:-1]), "damaged"),
    "longer": (lambda path: path.write_bytes(path.read_bytes() + b"x"), "damaged"),
    "swapped": (lambda path: save_file(turned(load_file(path)), path, described(path)), "checksum"),
    "described again": (
        lambda path: save_file(load_file(path), path, described(path, rate=0.2)),
        "checksum",
    ),
    "of another origin": (lambda path: save_file(load_file(path), path), "checksum"),
}


@pytest.mark.parametrize("name", SPOILT)
def test_a_file_that_was_changed_is_refused(stored, name):
    spoil, said = SPOILT[name]
    spoil(stored)
    refuses(stored, said, {**MADE_FOR, "rate": 0.2} if name == "described again" else MADE_FOR)


FULL = OSError(28, "No space left on device")


@pytest.mark.parametrize(
    ("step", "error"), [("fsync", FULL), ("replace", FULL), ("replace", KeyboardInterrupt())]
)
def test_an_interrupted_write_leaves_the_old_file(stored, monkeypatch, step, error):
    before = stored.read_bytes()

    def fail(*args):
        raise error

    monkeypatch.setattr(os, step, fail)
    expected = ConfigurationError if error is FULL else KeyboardInterrupt
    with pytest.raises(expected, match="net.safetensors: No space left on device|^$"):
        save_artefact(stored, net(seed=1), MADE_FOR)
    assert stored.read_bytes() == before
    assert [path.name for path in stored.parent.iterdir()] == [stored.name]


def test_folders_are_made_and_impossible_ones_reported(tmp_path):
    write_whole(tmp_path / "a" / "b" / "file", b"content")
    assert (tmp_path / "a" / "b" / "file").read_bytes() == b"content"
    with pytest.raises(ConfigurationError, match="cannot write"):
        write_whole(tmp_path / "a" / "b" / "file" / "below", b"content")


def test_the_cache_trains_once_for_each_description(tmp_path):
    calls = []

    def train(module, value):
        calls.append(value)
        nn.init.constant_(module[0].weight, value)
        return value / 10

    def use(description, value):
        module = net(seed=len(calls))
        outcome = cached(tmp_path, module, description, lambda: train(module, value))
        return module, outcome

    first, outcome = use(MADE_FOR, 1.0)
    assert outcome == (0.1, False)
    again, outcome = use({**MADE_FOR, "sizes": (3, 2)}, 2.0)
    assert outcome == (0.1, True) and same_weights(first, again)
    other, outcome = use({**MADE_FOR, "rate": 0.2}, 3.0)
    assert outcome == (0.3, False) and not same_weights(first, other)
    assert calls == [1.0, 3.0]
    assert len(list(tmp_path.glob("net-*.safetensors"))) == 2


def test_what_a_killed_write_left_is_removed_before_the_next_one(tmp_path):
    def left(name):
        file = tmp_path / name
        part = file.with_name(f".{file.name}.0123456789ab")
        part.write_bytes(b"a part")
        return part

    cached(tmp_path, net(), MADE_FOR, lambda: 0.0)
    (path,) = tmp_path.glob("net-*")
    path.unlink()
    own, other = left(path.name), left("net-of-another-training.safetensors")
    cached(tmp_path, net(), MADE_FOR, lambda: 0.0)
    assert path.exists() and not own.exists()
    assert other.exists()  # another process may write it now
    checkpoints = Checkpoints(tmp_path / "run", {"seed": 3}, every=0.0)
    checkpoints.write(1, {"x": torch.ones(2)})
    parts = [left(f"run/{name}") for name in ("checkpoint-0000002.safetensors", "log.csv")]
    hidden = tmp_path / "run" / ".keep"
    hidden.write_bytes(b"no part")
    checkpoints.write(3, {"x": torch.ones(2)})
    assert hidden.exists() and not any(part.exists() for part in parts)


def test_a_damaged_cache_is_reported_not_used(tmp_path):
    cached(tmp_path, net(), MADE_FOR, lambda: 0.0)
    (path,) = tmp_path.glob("net-*")
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ArtefactError, match=path.name):
        cached(tmp_path, net(), MADE_FOR, lambda: 0.0)
