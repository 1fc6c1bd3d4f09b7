"""A run's folder holds its old results or its new ones, whole, or says that it is unfinished."""

import errno
import functools
import os
import shutil
import signal
import time

import pandas as pd
import pytest
from harness import files_of

from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.jobs.layout import is_finished
from afm_rl.jobs.process import handled
from afm_rl.jobs.run import Stop, _publish, begin, finish, needs_run
from afm_rl.storage.manifest import check_manifest, extend_manifest

RESULTS = {"config.yaml", "missions.csv", "steps.parquet", "compute.csv", "measures.json"}
SAME = ("missions.csv", "steps.parquet")  # to the byte


class Killed(BaseException):
    """Stands for SIGKILL."""


def go(folder, cfg, overwrite=False):
    """Run what is left to run."""
    if needs_run(folder, cfg, overwrite):
        begin(folder, cfg)
        finish(folder, echo=lambda line: None)
    return files_of(folder)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["physics", "afm_physics", "oracle"])
def test_all_but_the_old_physics_reach_every_target(configure, tmp_path, method):
    change = [{"v_gain": -1.0, "omega_gain": 1.0}]
    go(tmp_path, configure(method, budget=120, seeds=2, regimes=change))
    missions = pd.read_csv(tmp_path / "missions.csv")
    if method == "physics":
        assert (missions["reached"] < 10).all() and not missions["finished"].any()
        return
    assert (missions["reached"] == 20).all() and missions["finished"].all()
    # In a closed loop the last bit of a processor grows to whole steps.
    assert missions["steps"].to_list() == pytest.approx([105, 105], rel=0.1)


def test_a_finished_run_is_left_alone(configure, tmp_path):
    before = go(tmp_path, configure())
    assert not needs_run(tmp_path, configure(progress=False, threads=2, cache="elsewhere"))
    finish(tmp_path)
    assert files_of(tmp_path) == before


def test_results_of_another_version_are_refused(configure, tmp_path, monkeypatch):
    go(tmp_path, configure())
    monkeypatch.setattr("afm_rl.jobs.run.__version__", "99")
    with pytest.raises(ConfigurationError, match=r"\(version: .* -> 99\)"):
        needs_run(tmp_path, configure())


@pytest.mark.parametrize("name", ["missions.csv", "figures", "video"])
def test_what_is_not_of_a_run_is_not_replaced(configure, tmp_path, name):
    (tmp_path / name).mkdir()
    with pytest.raises(ConfigurationError, match=f"holds {name} without manifest.json"):
        needs_run(tmp_path, configure())
    assert needs_run(tmp_path, configure(), overwrite=True)


def test_the_folder_of_a_batch_is_refused(configure, tmp_path):
    (tmp_path / "jobs").mkdir()
    with pytest.raises(ConfigurationError, match="holds jobs"):
        needs_run(tmp_path, configure(), overwrite=True)


def test_damaged_results_are_refused_and_named(configure, tmp_path):
    before = go(tmp_path, configure())
    for name in RESULTS:  # tests/storage/test_manifest.py flips many bits
        (tmp_path / name).write_bytes(before[name][:-1])
        with pytest.raises(ArtefactError, match=f"{name}: damaged"):
            needs_run(tmp_path, configure())
        (tmp_path / name).write_bytes(before[name])
    assert not needs_run(tmp_path, configure())


@pytest.mark.parametrize("text", [b"", b"a: [", b"- 3", b"\xff", b"[" * 9999])
def test_unfinished_runs_with_damaged_settings_are_refused(configure, tmp_path, text):
    (tmp_path / "unfinished").mkdir()
    (tmp_path / "unfinished" / "config.yaml").write_bytes(text)
    with pytest.raises(ArtefactError, match="unfinished/config.yaml: damaged"):
        needs_run(tmp_path, configure())


def test_an_unfinished_run_of_other_settings_is_refused_or_replaced(configure, tmp_path):
    begin(tmp_path, configure())
    other = configure(budget=9)
    with pytest.raises(ConfigurationError, match="budget: 12 -> 9"):
        needs_run(tmp_path, other)
    go(tmp_path, other, overwrite=True)
    assert len(pd.read_parquet(tmp_path / "steps.parquet")) == 9


CHANGES = ("replace", "unlink", "rmdir", "fsync")  # of the disk


def killed_at(monkeypatch, count, work):
    """Do some work; return whether it was killed before a change of the disk, counted from 0."""
    left = count

    def change(real, *args, **settings):
        nonlocal left
        left -= 1
        if left < 0:
            raise Killed
        return real(*args, **settings)

    with monkeypatch.context() as patched:
        for name in CHANGES:
            patched.setattr(os, name, functools.partial(change, getattr(os, name)))
        try:
            work()
        except Killed:
            return True
    return False


def test_new_results_replace_old_ones_whole_or_not_at_all(configure, tmp_path, monkeypatch):
    """A kill before each change of the disk in turn: never a mixture, and nothing is lost."""
    state, cfg, results = tmp_path / "state", configure(seeds=[5]), []
    old, new = go(state, configure()), go(tmp_path / "new", cfg)
    (state / "figures").mkdir()
    (state / "figures" / "old.png").write_bytes(b"old")
    extend_manifest(state, ["figures"])
    begin(state, cfg)
    with monkeypatch.context() as patched:
        patched.setattr("afm_rl.jobs.run._publish", lambda _, *found: results.extend(found))
        finish(state, echo=lambda line: None)

    def publish():
        if (folder / "unfinished" / "config.yaml").exists():  # as `finish` does
            _publish(folder, *results)

    for kills in range(99):
        folder = shutil.copytree(state, tmp_path / str(kills))
        killed = False
        for _ in range(2):  # twice at the same place
            killed |= killed_at(monkeypatch, kills, publish)
            if is_finished(folder):
                check_manifest(folder)
                now = files_of(folder)
                assert any(all(now[name] == each[name] for name in SAME) for each in (old, new))
        publish()
        now = files_of(folder)
        assert now.keys() == new.keys() and all(now[name] == new[name] for name in SAME)
        check_manifest(folder)
        if not killed:
            break
    assert 20 < kills < 99


@pytest.mark.parametrize("when", [0, 6, 12])
def test_a_full_disk_leaves_the_old_results(configure, tmp_path, monkeypatch, when):
    """The disk is full at one write after another; what was there stays, whole."""
    old, room = go(tmp_path, configure()), when

    def full(number):
        nonlocal room
        room -= 1
        if room < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(number)

    real = os.fsync
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ConfigurationError, match="cannot write .*: No space left on device"):
        go(tmp_path, configure(seeds=[5], **{"checkpoints.every": 0}), overwrite=True)
    monkeypatch.undo()
    now = files_of(tmp_path)
    assert {name: now[name] for name in old} == old
    assert not [name for name in now if "/." in name]  # no part of a file
    check_manifest(tmp_path)
    new = go(tmp_path, configure(seeds=[5]), overwrite=True)
    assert new.keys() == old.keys() and new["missions.csv"] != old["missions.csv"]


def test_a_signal_waits_for_the_step_and_a_second_one_does_not():
    stop, before = Stop(), signal.getsignal(signal.SIGTERM)
    with handled(stop, signal.SIGTERM):
        stop.waits = True
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)
        assert stop.asked
        with pytest.raises(KeyboardInterrupt):
            stop()
    with pytest.raises(KeyboardInterrupt):
        Stop()()
    assert signal.getsignal(signal.SIGTERM) == before
