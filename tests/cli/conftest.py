"""The command line, in this process and in one of its own."""

import logging

import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.singleton import Singleton

from afm_rl import cli
from afm_rl.jobs import process as jobs_process

QUICK = ["progress=false", "figures=false", "tensorboard=false"]


@pytest.fixture
def quick():
    """Settings of a run that only writes its tables."""
    return [*QUICK, "planner.candidates=16"]


@pytest.fixture
def afm_rl(monkeypatch, capsys, cache, called):
    """Call the command line in this process; return status, output and errors."""
    monkeypatch.setenv("AFM_RL_CACHE", str(cache))
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(jobs_process, "START", "fork")  # saves jobs the imports
    root, states = logging.getLogger(), Singleton.get_state()
    handlers, level, threads = root.handlers[:], root.level, torch.get_num_threads()

    def main():
        GlobalHydra.instance().clear()
        capsys.readouterr()
        cli.main()

    yield lambda *arguments: called(main, "afm-rl", *arguments)
    GlobalHydra.instance().clear()
    Singleton.set_state(states)
    root.handlers[:], root.level = handlers, level
    torch.set_num_threads(threads)
