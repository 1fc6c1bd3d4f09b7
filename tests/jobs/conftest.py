"""Small configurations."""

import copy
import functools
import math

import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from afm_rl.jobs.executor import Executor
from afm_rl.jobs.run import finish


class Here(Executor):
    """Runs jobs in this process, one after the other."""

    tick = 0.0

    def start(self, jobs):
        for job in jobs:
            finish(job.folder, echo=lambda line: None)
        return jobs

    def is_over(self, handle):
        return True

    def close(self, handles):
        pass


@pytest.fixture
def here():
    """An executor that runs jobs in this process."""
    return Here()


@functools.cache
def _composed(method):
    with initialize_config_module("afm_rl.conf", version_base="1.3"):
        return compose("config", [f"method={method}"])


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """Folder of trained parts that all these tests share."""
    return tmp_path_factory.getbasetemp() / "trained_parts"


@pytest.fixture
def ring(tmp_path_factory):
    """A round track of 20 targets, 1 m apart."""
    path = tmp_path_factory.mktemp("tracks") / "ring.csv"
    corners = [2 * math.pi * k / 19 for k in range(19)]
    points = [f"{3.02 * math.cos(a):.4f},{3.02 * math.sin(a):.4f}\n" for a in corners]
    path.write_text("x,y\n" + "".join(points))
    return str(path)


@pytest.fixture
def configure(ring, cache):
    """Make a small configuration of a method."""

    def make(method="physics", **settings):
        cfg = copy.deepcopy(_composed(method))
        small = {"label": method, "tracks": [ring], "budget": 12, "cache": str(cache)}
        for key, value in {**small, "planner.population": 16, **settings}.items():
            OmegaConf.update(cfg, key, value)
        return cfg

    return make
