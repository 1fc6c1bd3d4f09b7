"""Machine code runs only if it is what was written here."""

import os
import stat
from pathlib import Path

import pytest
import torch
from torch import nn

from afm_rl.compiling import machine_code
from afm_rl.compiling.machine_code import checksum_of, claim, folder_in, keep, recall

CODE = os.urandom(1000)


@pytest.fixture(scope="module", autouse=True)
def own_key(tmp_path_factory):
    """Keep the key of this user out of the tests."""
    machine_code._secret.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AFM_RL_CACHE", str(tmp_path_factory.mktemp("own")))
        yield
    machine_code._secret.cache_clear()


@pytest.fixture
def path(tmp_path):
    """A program that is kept."""
    keep(tmp_path / "compiled" / "a.pt2", CODE)
    return tmp_path / "compiled" / "a.pt2"


def test_a_program_comes_back_from_a_folder_that_is_ours_alone(path):
    assert recall(path) == (CODE, "") and recall(path.with_name("b.pt2")) == (None, "")
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    note = path.with_suffix(".sha256").read_text()
    assert note == f"{checksum_of(CODE)}  a.pt2\n"  # as sha256sum reads it


def test_every_bit_that_flips_is_found(path):
    for bit in range(0, 8 * len(CODE), 79):
        damaged = bytearray(CODE)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        code, why = recall(path)
        assert code is None and why == f"{path} is not what its checksum says"


def planted(path):
    path.with_suffix(".sha256").unlink()


def cut(path):
    path.write_bytes(CODE[:-1])


def open_to_all(path):
    path.parent.chmod(0o777)


def open_to_the_group(path):
    path.parent.chmod(0o770)


FAULTS = {
    planted: "has no checksum",
    cut: "is not what its checksum says",
    open_to_all: "others may write into",
    open_to_the_group: "others may write into",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_others_may_have_written_is_not_read(path, fault):
    fault(path)
    code, why = recall(path)
    assert code is None and FAULTS[fault] in why
    keep(path, b"anew")
    assert recall(path) == (b"anew", "")


def test_whatever_lay_in_an_open_folder_is_removed(path):
    keep(path.with_name("b.pt2"), CODE)
    (path.parent / "torch").mkdir()
    path.parent.chmod(0o777)
    assert claim(path.parent) and not list(path.parent.iterdir())


def test_a_folder_of_another_user_is_left_alone(path, monkeypatch):
    monkeypatch.setattr(os, "getuid", lambda: path.stat().st_uid + 1)
    assert recall(path) == (None, f"{path.parent} belongs to another user")
    keep(path, b"mine")
    assert path.read_bytes() == CODE


def test_a_link_to_a_folder_is_not_followed(path, tmp_path):
    link = tmp_path / "link"
    link.symlink_to(path.parent)
    assert "belongs to another user" in recall(link / "a.pt2")[1] and not claim(link)


def test_a_cache_from_elsewhere_holds_no_program_that_is_run(tmp_path, monkeypatch):
    mine = folder_in(tmp_path / "a")
    key = Path(os.environ["AFM_RL_CACHE"], "key")
    assert mine.parent == tmp_path / "a" and stat.S_IMODE(key.stat().st_mode) == 0o600
    assert folder_in(tmp_path / "b").name != mine.name  # a copy elsewhere
    machine_code._secret.cache_clear()  # as in the next process
    assert folder_in(tmp_path / "b" / ".." / "a") == mine
    for place in (tmp_path / "another user", key):  # the latter cannot hold a key
        monkeypatch.setenv("AFM_RL_CACHE", str(place))
        machine_code._secret.cache_clear()
        assert folder_in(tmp_path / "a").name != mine.name


class Doubled(nn.Module):
    def forward(self, *given):
        return (2.0 * given[0],)


def run(cache):
    """Return what the compiled module makes of ones; None if it goes on uncompiled."""
    found = machine_code.compile_module(Doubled(), [torch.ones(2, 1)], cache, traced=False)
    return None if found is None else found(torch.ones(3, 1))[0].flatten().tolist()


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
    (path,) = folder_in(compiled).glob("*.pt2")
    claim(folder_in(tmp_path))
    return folder_in(tmp_path) / path.name, path.read_bytes()


@pytest.mark.slow
def test_a_real_program_runs_at_once_the_second_time(real, tmp_path, capfd):
    keep(*real)
    assert run(tmp_path) == [2.0] * 3 and "compiling" not in capfd.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["planted", "one bit", "open folder"])
def test_a_real_program_that_may_be_anothers_does_not_run(
    real, fault, tmp_path, capfd, monkeypatch
):
    path, code = real
    if fault == "planted":
        path.write_bytes(code)
    elif fault == "one bit":
        keep(path, code)
        middle = len(code) // 2
        path.write_bytes(code[:middle] + bytes([code[middle] ^ 1]) + code[middle + 1 :])
    else:
        keep(path, code)
        path.parent.chmod(0o777)
    ran = []
    monkeypatch.setattr(machine_code, "loaded", ran.append)
    with pytest.warns(UserWarning, match="goes on uncompiled: no C.. compiler"):
        assert run(tmp_path) is None
    (line,) = capfd.readouterr().out.splitlines()
    assert line.endswith(": compiling anew") and str(path.parent) in line and not ran
