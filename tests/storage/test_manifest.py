"""Damaged results are found, and the damaged file is named."""

import hashlib
import json
import os
import random

import pandas as pd
import pytest
import torch
from safetensors.torch import save_file

from afm_rl.errors import ArtefactError
from afm_rl.storage.manifest import (
    MANIFEST,
    check_manifest,
    extend_manifest,
    read_verified,
    write_manifest,
)

KINDS = [
    *("missions.csv", "compute.csv", "steps.parquet", "config.yaml", "model.safetensors"),
    *("figures/a.png", "tensorboard/a/events", MANIFEST),
]


@pytest.fixture
def folder(tmp_path):
    """A folder with a file of every kind, and things that are none of the run's."""
    table = pd.DataFrame({"mission": [0, 1], "steps": [3, 4]})
    for name in ("figures", "tensorboard/a", "jobs/physics"):
        (tmp_path / name).mkdir(parents=True)
    table.to_csv(tmp_path / "missions.csv")
    table.to_csv(tmp_path / "compute.csv")
    table.to_parquet(tmp_path / "steps.parquet")
    save_file({"weight": torch.ones(3)}, tmp_path / "model.safetensors")
    (tmp_path / "config.yaml").write_text("budget: 50\nseeds: [1]\n")
    (tmp_path / "figures" / "a.png").write_bytes(os.urandom(99))
    (tmp_path / "tensorboard" / "a" / "events").write_bytes(os.urandom(99))
    (tmp_path / ".lock").touch()
    write_manifest(tmp_path / "jobs" / "physics")
    write_manifest(tmp_path)
    return tmp_path


def test_every_file_is_named_but_hidden_ones_and_other_runs(folder):
    assert sorted([*check_manifest(folder), MANIFEST]) == sorted(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_any_flipped_bit_is_found_and_the_file_named(folder, kind):
    path, dice = folder / kind, random.Random(0)
    whole = path.read_bytes()
    for _ in range(100):
        damaged = bytearray(whole)
        damaged[dice.randrange(len(whole))] ^= 1 << dice.randrange(8)
        path.write_bytes(damaged)
        for look in (check_manifest, lambda folder: read_verified(folder, kind)):
            with pytest.raises(ArtefactError) as found:
                look(folder)
            assert str(path) in str(found.value)
    path.write_bytes(whole)
    assert kind == MANIFEST or read_verified(folder, kind) == whole
    check_manifest(folder)


def test_files_that_the_manifest_does_not_name_are_not_verified(folder):
    with pytest.raises(ArtefactError, match="does not name it"):
        read_verified(folder, "jobs/physics/manifest.json")


@pytest.mark.parametrize("kind", KINDS)
def test_files_that_are_cut_or_gone_are_found(folder, kind):
    path = folder / kind
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ArtefactError, match=str(path)):
        check_manifest(folder)
    path.unlink()
    with pytest.raises(ArtefactError, match=str(path)):
        check_manifest(folder)


@pytest.mark.parametrize("text", ["", "[]", "{}", "[" * 9999, '{"files": 3, "version": 1}', "\xff"])
def test_what_is_no_manifest_is_refused(folder, text):
    (folder / MANIFEST).write_bytes(text.encode("latin-1"))
    with pytest.raises(ArtefactError, match="manifest.json: "):
        check_manifest(folder)


@pytest.mark.parametrize("where", ["../config.yaml", "absolute"])
def test_a_manifest_cannot_name_files_elsewhere(folder, where):
    """Not even one with a right checksum of its own."""
    name = str(folder / "config.yaml") if where == "absolute" else where
    content = {"version": "1", "files": {name: "0" * 64}}
    own = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    text = json.dumps({**content, "sha256": own}, indent=1, sort_keys=True) + "\n"
    (folder / "figures" / MANIFEST).write_text(text)
    with pytest.raises(ArtefactError, match="manifest.json: damaged"):
        check_manifest(folder / "figures")


def test_files_are_added_later(folder):
    (folder / "video").mkdir()
    (folder / "video" / "physics.gif").write_bytes(b"film")
    extend_manifest(folder, ["video"])
    assert "video/physics.gif" in check_manifest(folder)
