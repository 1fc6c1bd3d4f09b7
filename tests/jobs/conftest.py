"""Small configurations."""

import copy
from types import SimpleNamespace

import pytest
from harness import composed
from omegaconf import OmegaConf

from afm_rl.jobs.executor import Executor
from afm_rl.jobs.run import finish


class Here(Executor):
    """Runs jobs in this process, one after the other."""

    def start(self, job):
        finish(job.folder, echo=lambda line: None)
        return SimpleNamespace(is_alive=lambda: False, exitcode=0)

    def close(self, processes):
        pass


@pytest.fixture
def here():
    """An executor that runs jobs in this process."""
    return Here()


@pytest.fixture
def configure(ring, cache):
    """Make a small configuration of a method."""

    def make(method="physics", **settings):
        cfg = copy.deepcopy(composed(f"method={method}"))
        small = {"label": method, "tracks": [ring], "budget": 12, "cache": str(cache)}
        small["tensorboard"] = False
        for key, value in {**small, "planner.candidates": 16, **settings}.items():
            OmegaConf.update(cfg, key, value)
        return cfg

    return make
