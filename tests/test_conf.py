"""Every choice of every configuration group composes and runs."""

import copy
import inspect
import itertools
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import yaml
from harness import composed, shrink
from omegaconf import OmegaConf
from tensordict import unravel_key

import afm_rl.conf
from afm_rl.missions import build, prepare, run
from afm_rl.missions.build import DEFAULTS
from afm_rl.options import options_of, parts_of
from afm_rl.report import write_run
from afm_rl.trust import find_code

CONF = Path(afm_rl.conf.__file__).parent
FILES = sorted([*CONF.glob("*/*.yaml"), *CONF.glob("hydra/*/*.yaml")])
GROUPS = {
    folder: [path.stem for path in paths]
    for folder, paths in itertools.groupby(FILES, lambda path: path.parent.name)
}
ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
POLICY = Path(__file__).parents[1] / "examples" / "policies" / "pendulum_sac.safetensors"
OWN = [f"robot.xml={ASSETS / 'inverted_pendulum.xml'}"]
OWN += ["robot.reward=afm_rl.envs.task.rewards.upright"]
PARTNERS = {  # what else must be chosen for a choice to make sense
    "dynamics=oracle": ["updater=oracle"],
    "dynamics=knode": ["robot=quadrotor"],
    "dynamics=knode_offline": ["robot=quadrotor"],
    "updater=oracle": ["dynamics=oracle"],
    "updater=online": ["dynamics=pe"],
    "updater=rls": ["dynamics=calibrated"],
    "updater=rls_unmatched": ["dynamics=calibrated"],
    "updater=online_unmatched": ["dynamics=pe"],
    "updater=stream_x": ["dynamics=pe_stream_x"],
    "updater=stream_x_unmatched": ["dynamics=pe_stream_x"],
    "updater=knode": ["dynamics=knode", "robot=quadrotor"],
    "planner=mpc": ["robot=quadrotor"],
    "planner=policy": ["robot=gymnasium", f"planner.file={POLICY}"],
    "method=offline_knode": ["robot=quadrotor"],
    "method=online_knode": ["robot=quadrotor"],
    "method=afm_online_knode": ["robot=quadrotor"],
    "cost=tracking": ["robot=quadrotor"],
    "cost=reward": ["robot=gymnasium"],
    "robot=mujoco": OWN,
}


def choices(group):
    """Name every choice of a group, with the partners that it needs."""
    for name in GROUPS[group]:
        yield [f"{group}={name}", *PARTNERS.get(f"{group}={name}", [])]


# Each choice once against the defaults; a planner also over a model of two missions that learns.
EACH = [
    *(each for group in ("dynamics", "method", "updater", "corrector") for each in choices(group)),
    *choices("planner"),
]
EACH += [["method=online_pe", "seeds=2", *planner] for planner in choices("planner")]
EACH += [[*cost, "method=afm_physics"] for cost in choices("cost")]
EACH += choices("robot")
CHECKED = ["dynamics=calibrated", "method=afm_physics", "updater=rls", "corrector=adaptive_gain"]
CHECKED += ["planner=icem", "cost=goal_pose", "robot=quadrotor"]  # one of each group
EACH = [
    pytest.param(
        overrides,
        id=" ".join(overrides),
        marks=pytest.mark.check if overrides[0] in CHECKED else pytest.mark.slow,
    )
    for overrides in EACH
]


def check_that_parts_share_one_model(agent, cfg):
    """Planner, transform and updater have the model that is trained, if it learns before."""
    corrects = not cfg.corrector._target_.endswith("no_correction")
    assert (agent.transform is not None) == corrects
    owners = [agent.planner.env, agent.updater.loss, *[agent.transform] * corrects]
    models = [getattr(owner, "dynamics", None) or owner.model for owner in owners]
    assert all(model is agent.model for model in models)
    settings = cfg.dynamics.get("base", cfg.dynamics)
    trained = agent.model.model if "base" in cfg.dynamics else agent.model
    models = [part.module for part in agent.trainings if part.title in ("ensemble", "KNODE")]
    assert models == [trained] * (settings.get("pretrain") is not None)
    assert unravel_key(agent.executed_key) == ("next", "guard", "executed_action")


@pytest.mark.parametrize("overrides", EACH)
def test_every_choice_runs(overrides, cache, tmp_path):
    cfg = shrink(copy.deepcopy(composed(*overrides)), {"budget": 5})
    agent = build(cfg)
    if overrides[0].startswith("method="):
        check_that_parts_share_one_model(agent, cfg)
    prepare(agent, cache, echo=lambda line: None)
    results = run(agent)
    assert results.steps["t"].tolist() == [0, 1, 2, 3, 4] * len(results.missions)
    assert np.isfinite(results.steps.to_numpy(dtype=float)).all()
    assert results.missions["steps"].eq(4).all()
    if overrides[0].startswith("robot="):  # of each robot everything can be drawn
        parts = results.missions, results.steps, results.measures
        roads = getattr(agent.base_env, "tracks", ())
        write_run(tmp_path, *parts, roads, echo=lambda line: None)


@pytest.mark.parametrize("method", GROUPS["method"])
def test_a_method_chooses_three_parts_and_nothing_else(method):
    text = (CONF / "method" / f"{method}.yaml").read_text()
    assert text.startswith("# @package _global_\n")
    loaded = OmegaConf.create(text)
    assert list(loaded) == ["defaults"]
    parts = [next(iter(entry)).removeprefix("override /") for entry in loaded.defaults]
    assert parts == ["dynamics", "updater", "corrector"]


def test_a_robot_may_choose_a_cost_and_a_planner_but_the_user_has_the_last_word():
    given = ["planner=cem", "cost=goal_pose", "tracks=hover", "regimes=none", "compare=[oracle]"]
    own, chosen = composed("robot=quadrotor"), composed("robot=quadrotor", *given)
    assert set(own.compare) <= set(GROUPS["method"]) and chosen.compare == ["oracle"]
    names = "planner._target_", "cost._target_", "tracks", "regimes"
    told = [
        [OmegaConf.select(cfg, name).split(".planning.")[-1] for name in names]
        for cfg in (own, chosen)
    ]
    assert told[0] == ["MPC", "TrackingCost", "circle_2m_0.8mps", "paper"]
    assert told[1] == ["CEM", "GoalDistance", "hover", "none"]


VARIANTS = {  # choices that are there because they differ
    *("planner/mppi_paper", "corrector/adaptive_affine", "dynamics/pe_stream_x"),
    *("dynamics/pe_dr", "updater/rls_unmatched", "cost/goal_pose"),
}
OF_THE_ROBOT = ("seed_key", "bounds_key", "bounded", "rest", "frame")  # what not every robot has
OF_CODE = [
    path
    for group in ("planner", "cost", "dynamics", "updater", "corrector")
    for path in sorted((CONF / group).glob("*.yaml"))
    if f"{group}/{path.stem}" not in VARIANTS and "_target_" in path.read_text()
]


def differing(target, settings):
    """Yield name, value and default of the options that a file sets to something else."""
    known = options_of(target)
    for name, value in settings.items():
        if name == "pretrain" and value:
            yield from differing(parts_of(target)[name], value)
        elif name in known and name not in OF_THE_ROBOT and "${" not in str(value):
            default = known[name].default
            default = list(default) if isinstance(default, tuple) else default
            if value != default and default is not inspect.Parameter.empty:
                yield name, value, default


@pytest.mark.parametrize("path", OF_CODE, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_defaults_of_the_command_line_are_those_of_the_library(path):
    settings = yaml.safe_load(path.read_text())
    assert list(differing(find_code("_target_", settings["_target_"]), settings)) == []


def test_what_a_configuration_may_leave_out_has_the_values_of_ours():
    ours = yaml.safe_load((CONF / "config.yaml").read_text())
    assert {name: ours[name] for name in DEFAULTS} == DEFAULTS
