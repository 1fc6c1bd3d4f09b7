"""Machine code runs only if it is what was written here."""

import os
import signal
import stat
import sys
from pathlib import Path

import pytest
import torch
from torch import nn

from afm_rl.compiling import machine_code
from afm_rl.storage import signed
from afm_rl.storage.signed import read_signed, write_signed

CODE = os.urandom(1000)


@pytest.fixture(scope="module", autouse=True)
def own_key(tmp_path_factory):
    """Keep the key of this user out of the tests."""
    signed._key.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AFM_RL_CACHE", str(tmp_path_factory.mktemp("own")))
        yield
    signed._key.cache_clear()


@pytest.fixture
def path(tmp_path):
    """A program that is kept."""
    write_signed(tmp_path / "compiled" / "a.pt2", CODE)
    return tmp_path / "compiled" / "a.pt2"


def test_a_program_comes_back_in_this_process_and_the_next(path):
    assert read_signed(path) == CODE and read_signed(path.with_name("b.pt2")) is None
    key = Path(os.environ["AFM_RL_CACHE"], "key")
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    signed._key.cache_clear()
    assert read_signed(path) == CODE


def test_every_bit_that_flips_is_found(path):
    whole = path.read_bytes()
    for bit in range(0, 8 * len(whole), 79):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        assert read_signed(path) is None


@pytest.mark.parametrize(
    "change",
    [
        lambda path: path.write_bytes(CODE),
        lambda path: path.write_bytes(path.read_bytes()[:-1]),
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.with_name("b.pt2").read_bytes()),
    ],
    ids=["planted", "cut", "empty", "another one"],
)
def test_what_was_not_written_here_is_not_read(path, change):
    write_signed(path.with_name("b.pt2"), b"another")
    change(path)
    assert read_signed(path) is None
    write_signed(path, b"anew")
    assert read_signed(path) == b"anew"


def another_user(monkeypatch, tmp_path, key):
    monkeypatch.setenv("AFM_RL_CACHE", str(tmp_path / "another user"))


def no_place(monkeypatch, tmp_path, key):
    monkeypatch.setenv("AFM_RL_CACHE", str(key))  # a file cannot hold a key


def known_to_others(monkeypatch, tmp_path, key):
    key.chmod(0o640)


def of_another(monkeypatch, tmp_path, key):
    monkeypatch.setattr(os, "getuid", lambda: key.stat().st_uid + 1)


@pytest.mark.parametrize("change", [another_user, no_place, known_to_others, of_another])
def test_the_key_is_this_user_s_alone(path, change, monkeypatch, tmp_path):
    key = Path(os.environ["AFM_RL_CACHE"], "key")
    change(monkeypatch, tmp_path, key)
    signed._key.cache_clear()
    try:
        assert read_signed(path) is None
        write_signed(path, CODE)
        assert read_signed(path) == CODE
    finally:
        signed._key.cache_clear()
        key.chmod(0o600)


class Doubled(nn.Module):
    def forward(self, *given):
        return (2.0 * given[0],)


def doubled(cache):
    return machine_code.compile_module(Doubled(), [torch.ones(2, 1)], cache, traced=False)


def run(cache):
    """Return what the compiled module makes of ones; None if it goes on uncompiled."""
    found = doubled(cache)
    if isinstance(found, machine_code.Beside):
        assert found(torch.ones(3, 1))[0].flatten().tolist() == [2.0] * 3  # as it is, meanwhile
        found = found.finished(wait=True)
        assert not isinstance(found, nn.Module)
    return None if found is None else found(torch.ones(3, 1))[0].flatten().tolist()


@pytest.mark.skipif(sys.platform != "linux", reason="compiles in this process")
@pytest.mark.parametrize(
    ("fails", "reason"),
    [
        (lambda *_: 1 / 0, "division by zero"),
        (lambda *_: os.kill(os.getpid(), signal.SIGKILL), "the process that compiled was ended"),
    ],
)
def test_a_process_that_cannot_compile_leaves_the_module_as_it_is(
    tmp_path, monkeypatch, fails, reason
):
    monkeypatch.setattr(machine_code, "has_compiler", lambda: True)
    monkeypatch.setattr(machine_code, "_compile", fails)
    twins = doubled(tmp_path), doubled(tmp_path)  # of one process
    for twin in twins:
        with pytest.warns(UserWarning, match="compile=true: goes on uncompiled"):
            found = twin.finished(wait=True)
        assert isinstance(found, Doubled) and found(torch.ones(1))[0] == 2.0
    with pytest.warns(UserWarning, match=reason):
        doubled(tmp_path).finished(wait=True)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """A cache that holds one real program: the only one that these tests compile."""
    if not machine_code.has_compiler():
        pytest.skip("no C++ compiler")
    cache = tmp_path_factory.mktemp("cache")
    assert run(cache) == [2.0] * 3
    return cache


@pytest.fixture
def real(compiled, tmp_path, monkeypatch):
    """Where that program belongs in another cache, and its code; nothing else can be compiled."""
    monkeypatch.setattr(machine_code, "has_compiler", lambda: False)
    (path,) = compiled.glob("compiled/*.pt2")
    return tmp_path / "compiled" / path.name, read_signed(path)


@pytest.mark.slow
def test_a_real_program_runs_at_once_the_second_time(real, tmp_path, capfd):
    write_signed(*real)
    assert run(tmp_path) == [2.0] * 3 and "compiling" not in capfd.readouterr().out


@pytest.mark.slow
def test_a_real_program_that_may_be_anothers_does_not_run(real, tmp_path, capfd, monkeypatch):
    path, code = real
    path.parent.mkdir()
    path.write_bytes(code)
    ran = []
    monkeypatch.setattr(machine_code, "loaded", ran.append)
    with pytest.warns(UserWarning, match="goes on uncompiled: no C.. compiler"):
        assert run(tmp_path) is None
    (line,) = capfd.readouterr().out.splitlines()
    assert line == f"{path} was not written by you: compiling anew" and not ran
