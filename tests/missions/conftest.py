"""Small agents, composed as the command line composes them, and a small track."""

import copy
from types import SimpleNamespace

import pytest
from harness import composed, shrink, track_of
from omegaconf import OmegaConf

from afm_rl.missions import build, prepare, run
from afm_rl.trust import instantiate

SMALL = {"budget": 12, "planner.candidates": 16, "planner.elites": 4}


@pytest.fixture
def configure():
    """Make a small configuration from overrides."""

    def make(*overrides, **settings):
        cfg = copy.deepcopy(composed(*overrides))
        cfg.label = next((o.removeprefix("method=") for o in overrides if "method=" in o), None)
        shrink(cfg, SMALL)
        for key, value in settings.items():
            OmegaConf.update(cfg, key, value)
        return cfg

    return make


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


@pytest.fixture
def spot(tmp_path):
    """A track of three targets around the start: one is reached at each step."""
    return track_of(tmp_path / "spot.csv", [(0.0, 0.0), (0.02, 0.0)])
