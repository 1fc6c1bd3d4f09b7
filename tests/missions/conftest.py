"""Small agents, composed as the command line composes them, and a small track."""

import copy
import functools
import math
from types import SimpleNamespace

import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf
from small import shrink

from afm_rl.missions import build, prepare, run
from afm_rl.trust import instantiate

SMALL = {"budget": 12, "planner.population": 16, "planner.elites": 4}
TARGETS = 20  # of the ring


@pytest.fixture(scope="session")
def composed():
    """Compose a configuration from overrides, each once: it takes a tenth of a second."""

    @functools.cache
    def make(*overrides):
        with initialize_config_module("afm_rl.conf", version_base="1.3"):
            return compose("config", list(overrides))

    return make


@pytest.fixture
def configure(composed):
    """Make a small configuration from overrides."""

    def make(*overrides, **settings):
        cfg = copy.deepcopy(composed(*overrides))
        cfg.label = next((o.removeprefix("method=") for o in overrides if "method=" in o), None)
        shrink(cfg, SMALL)
        for key, value in settings.items():
            OmegaConf.update(cfg, key, value)
        return cfg

    return make


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """Folder of trained parts that all these tests share."""
    return tmp_path_factory.getbasetemp() / "trained_parts"


@pytest.fixture
def make_agent(configure, cache):
    """Build and prepare a small agent."""

    def make(*overrides, **settings):
        agent = build(configure(*overrides, **settings))
        prepare(agent, cache, echo=lambda line: None)
        return agent

    return make


@pytest.fixture
def drive(make_agent):
    """Run a small agent; return it with the tables of its missions and steps."""

    def go(*overrides, **settings):
        agent = make_agent(*overrides, **settings)
        results = run(agent)
        return SimpleNamespace(agent=agent, missions=results.missions, steps=results.steps)

    return go


@pytest.fixture
def robot(configure):
    """The ground robot."""
    return instantiate("robot", OmegaConf.to_container(configure().robot, resolve=True))


@pytest.fixture
def no_training(monkeypatch):
    """Fail when anything is trained."""

    def never(*args, **kwargs):
        raise AssertionError("trained, though the settings cannot be used")

    monkeypatch.setattr("afm_rl.missions.factories.Training.train", never)


def _track(path, points):
    path.write_text("x,y\n" + "".join(f"{x:.4f},{y:.4f}\n" for x, y in points))
    return str(path)


@pytest.fixture
def ring(tmp_path):
    """A round track of 20 targets, 1 m apart."""
    angles = [2 * math.pi * k / (TARGETS - 1) for k in range(TARGETS - 1)]
    radius = (TARGETS - 1) / (2 * math.pi)
    points = [(radius * math.cos(a), radius * math.sin(a)) for a in angles]
    return _track(tmp_path / "ring.csv", points)


@pytest.fixture
def spot(tmp_path):
    """A track of three targets around the start: one is reached at each step."""
    return _track(tmp_path / "spot.csv", [(0.0, 0.0), (0.02, 0.0)])
