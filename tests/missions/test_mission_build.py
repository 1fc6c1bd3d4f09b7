"""A configuration becomes an agent, or an error that names the setting."""

import dataclasses

import pytest
import torch
from harness import HIGH, LOW, refused
from torch import nn

from afm_rl.correction import PaperFlow
from afm_rl.errors import ArtefactError, ConfigurationError, refusing
from afm_rl.missions import build, prepare, run
from afm_rl.storage.artefacts import save_artefact


@pytest.mark.parametrize("clamp", [True, False])
def test_only_where_it_is_asked_for_actions_leave_the_box_of_the_robot(configure, cache, clamp):
    asked = ("method=afm_paper_code", "planner=mppi", f"corrector.clamp={str(clamp).lower()}")
    agent = build(configure(*asked, "dynamics=physics", "updater=frozen", "budget=60"))
    with torch.no_grad():  # a flow that asks for five times the box
        agent.transform.corrector.head[-1].bias.copy_(torch.tensor([5.0, -5.0]))
    planned, executed = (
        run(agent).steps[[f"{kind}_v", f"{kind}_omega"]].to_numpy()
        for kind in ("planned", "executed")
    )
    assert (abs(planned) <= [1.0, 1.58]).all()
    assert (abs(executed) <= [1.0, 1.58]).all() == clamp and abs(executed).max() <= 10 * 1.58


def test_a_planner_that_remembers_nothing_needs_no_primer(configure):
    agent = build(configure("planner=cem"))
    assert ("mppi", "mean") not in agent.env.observation_spec.keys(True, True)


@refused(
    (["dynamics=oracle"], "dynamics=oracle needs an updater that sets its regime"),
    (["updater=oracle"], "choose dynamics=oracle with updater=oracle, or neither"),
    (["dynamics=knode"], "robot=ugv: the rate of change of Dubins .* choose robot=quadrotor"),
    (["updater=knode"], "KNODEUpdater trains a KNODE, got Dubins; choose dynamics=knode"),
    (["robot=quadrotor", "dynamics=knode", "updater=oracle"], "dynamics=oracle needs an updater"),
    (["robot=quadrotor", "dynamics=knode", "dynamics.randomised=1"], "randomised=1"),
    (["robot=quadrotor", "dynamics=knode", "+dynamics.pretrain.lr=0"], "pretrain.lr=0"),
    (["robot=quadrotor", "dynamics=knode", "planner=mppi"], "choose planner=mpc"),
    (["updater=online"], "updater: the dynamics model has nothing to learn"),
    (["corrector=afm", "+corrector.train={seed: 1}"], "corrector: .* unexpected .*'train'"),
    (["+robot.env.horizn=3"], "robot.env: .* unexpected keyword argument 'horizn'"),
    (["cost.coordinates=[0, 7]"], "cost: .*index 7 is out of bounds"),
    (["cost.coordinates=[0]"], r"cost.coordinates=\[0\]: expected at least one per goal"),
    (["+cost.in_keys=[gaol]"], "cost: reads 2 numbers from 'gaol', .* gives nothing there"),
    (["planner.seed_key=[mission, sed]"], r"planner.seed_key=\('mission', 'sed'\): expected"),
    (
        ["method=adaptive_gain", "planner.bounds_key=[afm, reech]"],
        "planner.bounds_key=.*: expected",
    ),
    (["method=oracle", "updater.regime_key=gain"], "updater.regime_key='gain': expected one"),
    (["robot.state_names=[x, y]"], r"robot.state_names=\['x', 'y'\]: expected 3 names, each"),
    (["robot.action_names=[v, v]"], r"robot.action_names=\['v', 'v'\]: expected 2 names, each"),
    (["robot.goal_names=[x, z]"], "robot.goal_names=.*: expected some of x, y, theta"),
    (["~cost"], "^cost=None: expected settings; build needs those of robot, cost"),
    (["robot.goal_names=[x]"], r"robot.goal_names=\['x'\]: expected 2 names"),
    (["robot.schedule.at=0.5"], "robot.schedule: 'float' object is not iterable"),
    (["planner._target_=afm_rl.planning.Nope"], "planner._target_=.*planning.Nope.: cannot be"),
)
def test_parts_that_do_not_fit_are_refused(overrides, configure, no_training):
    build(configure(*overrides))


# Each constructor's own test has its ranges; here, that the setting is named as it was written.
@refused(
    ("physics", "label", "../../x", "label='../../x': expected a text"),
    ("physics", "budget", 10**20, "budget=1000.*: expected a whole number of at most 10000000"),
    ("physics", "planner.candidates", 10**11, "planner.candidates=.*at most 1000000"),
    ("physics", "robot.env.dt", 0, "dynamics.dt=0: expected a finite number"),
    ("online_pe", "dynamics.pretrain", 3, "dynamics.pretrain=3: expected settings"),
    ("online_pe", "updater.optimizer.lr", "abc", "updater.lr='abc': expected a finite"),
    says="^{}",
)
def test_settings_out_of_range_are_refused(method, key, value, configure, no_training):
    build(configure(f"method={method}", **{key: value}))


@refused(
    ({"action_low": [-1.0]}, r"robot.action_low=\[-1.0\], .* expected 2 numbers each"),
    ({"action_low": [2.0, -1.5]}, "robot.action_low=.* expected 2 numbers each, low <= high"),
    ({"state_high": [0.0, 0.0]}, "robot.state_high=.* expected 3 numbers each"),
    ({"state_low": [0.0, 0.0, float("nan")]}, "robot.state_low=nan: expected a finite number"),
    ({"action_high": ["a", 1.0]}, "robot.action_high='a': expected a finite number"),
    ({"features": [3]}, r"robot.features=\[3\]: expected distinct indices in 0..2"),
)
def test_a_robot_that_contradicts_its_model_is_refused(change, robot):
    dataclasses.replace(robot, **change)


def test_whole_numbers_are_numbers_too(drive):
    run = drive("method=afm_physics", **{"robot.action_low": [-1, -1], "robot.action_high": [1, 1]})
    assert run.steps[["executed_v", "executed_omega"]].abs().max().max() <= 1


def _checkpoint(path, flow):
    for parameter in flow.parameters():
        nn.init.constant_(parameter, 0.01)
    save_artefact(path, flow, flow.signature)
    return flow


def test_a_good_checkpoint_is_used(configure, no_training, tmp_path, cache):
    stored = _checkpoint(tmp_path / "flow", PaperFlow(LOW, HIGH, [2], 3, width=8))
    settings = {"corrector.checkpoint": str(tmp_path / "flow")}
    agent = build(configure("method=afm_physics", "corrector=paper", **settings))
    assert agent.trainings == []
    prepare(agent, cache)
    for name, value in stored.state_dict().items():
        assert torch.equal(agent.transform.corrector.state_dict()[name], value)


def test_the_regression_is_not_trained(configure, no_training):
    agent = build(configure("method=afm_physics"))
    assert agent.trainings == []
    assert not agent.transform.corrector.state_dict()


@pytest.mark.parametrize(
    ("flow", "complaint"),
    [
        (PaperFlow(LOW, HIGH, [0, 2], 3), "feature_size=7, expected feature_size=6"),
        (PaperFlow(LOW, HIGH, [2], 3, width=64), r"does not fit: .* size mismatch for .*\[64.*\[8"),
    ],
    ids=["features", "width"],
)
def test_a_checkpoint_of_another_flow_is_refused(configure, no_training, tmp_path, flow, complaint):
    _checkpoint(tmp_path / "flow", flow)
    settings = {"corrector.checkpoint": str(tmp_path / "flow")}
    cfg = configure("method=afm_physics", "corrector=paper", **settings)
    with pytest.raises(ConfigurationError, match=f"^corrector.checkpoint: {tmp_path}.*{complaint}"):
        build(cfg)


def test_our_own_errors_keep_their_words():
    with pytest.raises(ArtefactError, match="^damaged$"), refusing("flow"):
        raise ArtefactError("damaged")
    with pytest.raises(ConfigurationError, match="^robot: disk$"), refusing("robot"):
        raise OSError("disk")
