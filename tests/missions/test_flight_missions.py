"""Missions of the quadrotor, composed as the command line composes them."""

import dataclasses

import numpy as np
import pytest
import torch
from harness import refused

from afm_rl.errors import ConfigurationError
from afm_rl.missions import build, run

QUICK = {"robot.schedule.times": [0.1, 0.3], "budget": 12}


@pytest.fixture
def fly(drive):
    def go(*overrides, **settings):
        return drive("robot=quadrotor", *overrides, **{**QUICK, **settings})

    return go


def test_the_columns(fly):
    flown = fly("method=physics", tracks="all")
    names = list(flown.agent.robot.regime.names)
    assert list(flown.missions) == [
        *("mission", "method", "track", *names, "seed", "mse", "mse_z"),
        *("mse_phase_0", "mse_phase_1", "mse_phase_2", "peak_z", "settle_1", "settle_2"),
        *("steps", "finished", "faults", "seconds", "regime"),
    ]
    actions = ["thrust", "moment_x", "moment_y", "moment_z"]
    assert list(flown.steps) == [
        *("mission", "t", *flown.agent.robot.state_names, "goal_x", "goal_y", "goal_z"),
        *(f"planned_{name}" for name in actions),
        *(f"executed_{name}" for name in actions),
        *("error", "miss", "unforeseen", "corrected", "loss", "regime_active", "fault"),
        *("square_error_x", "square_error_y", "square_error_z", "phase"),
    ]
    assert flown.missions["track"].tolist() == list(flown.agent.robot.tracks)
    assert flown.missions["mass"].eq(0.5).all()
    assert flown.missions["regime"].eq("nominal; mass = 0.5; mass = 1.33333").all()
    assert flown.missions["finished"].all() and flown.missions["steps"].eq(11).all()
    first = flown.steps[flown.steps["mission"] == 0]
    assert first["phase"].tolist() == [0] * 2 + [1] * 4 + [2] * 6
    assert first["regime_active"].tolist() == [0] * 2 + [1] * 10


@pytest.mark.slow
def test_published_errors_are_met(drive):
    """R = 2 m, 8 s, one set-point held: Jiahao et al. 2022."""
    speeds = {0.8: 0.0904, 1: 0.1280, 1.2: 0.1705}
    settings = {"budget": 160, "robot.env.preview": False}
    tracks = [f"circle_2m_{speed}mps" for speed in speeds]
    flown = drive("robot=quadrotor", "method=physics", tracks=tracks, **settings)
    assert flown.missions["mse"].tolist() == pytest.approx(list(speeds.values()), abs=5e-4)
    assert flown.missions["peak_z"].between(0.3, 0.5).all()


def test_who_knows_the_mass_keeps_the_height(fly):
    physics, oracle = (
        fly(f"method={name}", budget=25).missions.iloc[0] for name in ("physics", "oracle")
    )
    assert oracle["mse_z"] < 1e-6 < 1e-3 < physics["mse_z"]
    assert oracle["settle_2"] == 0 < physics["settle_2"]


def test_a_lost_flight_leaves_the_batch(fly):
    flown = fly("method=physics", **{"robot.env.limit": 0.05, "robot.schedule.times": [0.05, 5]})
    assert not flown.missions["finished"].any()
    assert flown.missions["steps"].lt(11).all()
    assert np.isnan(flown.missions["mse_phase_2"]).all()


def assert_in_the_box(flown):
    robot, executed = flown.agent.robot, flown.steps.filter(regex="^executed_").to_numpy()
    low, high = robot.action_low, robot.action_high
    assert (executed >= np.array(low) - 1e-7).all() and (executed <= np.array(high) + 1e-7).all()


def test_a_thrust_that_cannot_be_negative_is_corrected_as_a_share_of_the_largest(fly):
    flown = fly("method=afm_physics")
    flow, robot = flown.agent.transform.corrector, flown.agent.robot
    torch.testing.assert_close(flow.scale, torch.tensor(robot.action_high))
    assert flown.steps["corrected"].sum() > 0
    assert_in_the_box(flown)
    whole = dataclasses.replace(robot, usual_low=None, usual_high=None)
    assert torch.equal(whole.usual_bounds[1], robot.action_bounds[1])


def test_the_published_flow_subtracts_quaternions_number_by_number(fly):
    settings = {"corrector.rule": "code", "corrector.train.iterations": 2}
    flown = fly("method=online_knode", "corrector=paper", budget=5, **settings)
    agent = flown.agent
    assert agent.transform.corrector.state_size == len(agent.robot.state_names) == 13
    assert flown.steps["corrected"].tolist()[:3] == [0, 0, 1]  # from the third step on
    assert_in_the_box(flown)


@refused(
    (
        ["method=online_knode", "corrector=paper", "corrector.wrap=true"],
        "corrector.wrap=true: robot=quadrotor has states with rotations",
    ),
    (["planner=mppi"], "planner: .* 6 successive targets in 'reference', .* takes one;"),
    (["robot.env.horizon=7"], "planner: .* 8 successive targets .* takes one or 21;"),
    (["cost=goal_pose"], "planner: got PlanningEnv with GoalDistance; MPC needs"),
    (["tracks=ethz_2"], "tracks='ethz_2': expected hover, a circle such as"),
    (["robot.goal_names=[x]"], r"robot.goal_names=\['x'\]: expected 3 names"),
    (["robot.score=null"], "robot.score=LapScore: reads goal, .* gives no goal, reached"),
    (["robot.score=3"], "robot.score=3: expected a Score, or null"),
    (["robot.usual_low=null"], r"robot.usual_low=\[\], .* expected 4 numbers each"),
    (["robot.usual_low=[0, 1, 1, 1]"], "robot.usual_low=.* expected 4 numbers each, low <"),
    (["robot.env.start=up"], "start='up': expected one of moving, rest"),
    (["regimes=[{v_gain: 0.5}]"], "regimes: unknown parameter 'v_gain'"),
    says="^{}",
)
def test_settings_that_do_not_fit_are_refused(overrides, configure, no_training):
    build(configure("robot=quadrotor", *overrides))


@pytest.mark.slow
def test_who_learns_keeps_the_height_better(fly):
    physics = fly("method=physics", budget=40).missions.iloc[0]
    learner = fly("method=online_knode", budget=40, **{"updater.begin": 0.1}).missions.iloc[0]
    assert learner["mse_z"] < 0.2 * physics["mse_z"]


@pytest.mark.slow
def test_a_correction_does_no_harm_beside_a_learner(fly):
    settings = {"robot.env.preview": False, "robot.schedule.times": [2.0, 9.0]}
    settings |= {"budget": 60, "tracks": ["circle_2m_0.3mps", "figure_8_8s"]}
    alone = fly("method=online_knode", **settings).missions
    corrected = fly("method=afm_online_knode", **settings).missions
    assert corrected["mse"].mean() < 1.02 * alone["mse"].mean()
    assert corrected["mse_z"].mean() < 1.25 * alone["mse_z"].mean()  # some 4 cm


def test_networks_learn_from_the_plants_own_steps_and_by_seed(make_agent):
    settings = {**QUICK, "updater.begin": 0.0, "updater.epochs": 2, "budget": 6}
    agent, windows = make_agent("robot=quadrotor", "method=online_knode", seeds=2, **settings), []

    def look(loop):
        windows.append(agent.updater.memory.get(("window", "state"), torch.zeros(0)).shape)

    flown = run(agent, stopped=look)
    # three ticks went into a network, which came a tick later; two wait for the next
    assert windows[4] == (2, 1, 2 * 25, 13)
    first, second = (rows["loss"].to_numpy() for _, rows in flown.steps.groupby("mission"))
    assert (first[:4] == second[:4]).all() and first[4] != second[4]


@pytest.mark.parametrize("randomised", [False, True])
def test_a_network_may_be_trained_before_the_flight(make_agent, randomised):
    settings = {"dynamics.randomised": randomised, **QUICK}
    agent = make_agent("robot=quadrotor", "method=offline_knode", **settings)
    assert [part.title for part in agent.trainings] == ["KNODE"]
    assert agent.model.networks.inner[0].any() and not agent.model.networks.inner[1:].any()
    assert np.isfinite(run(agent).steps.to_numpy(dtype=float)).all()


def test_before_it_learns_a_model_shares_the_flow_of_the_physics(configure):
    models = ["physics", "calibrated", "pe"]
    agents = [build(configure("corrector=paper", f"dynamics={model}")) for model in models]
    first, other, learned = [agent.trainings[-1].settings for agent in agents]
    assert other == first != learned


def test_correctors_learn_from_what_the_motors_gave(drive):
    pytest.importorskip("rotorpy")
    settings = {"robot.schedule.times": [0.1], "robot.env.substeps": 1, "budget": 8}
    regimes = [{"mass": 0.5}]
    flown = drive("robot=quadrotor_rotorpy", "method=afm_physics", regimes=regimes, **settings)
    assert flown.agent.executed_key == ("next", "wrench")
    assert flown.missions["steps"].eq(7).all()
    # A lag: sent is what is planned, and given is less of each change.
    thrust = flown.steps[["planned_thrust", "executed_thrust"]].to_numpy()
    assert thrust[4:, 0].min() < thrust[4:, 1].min()


def test_what_is_reported_must_be_an_entry(drive):
    pytest.importorskip("rotorpy")
    with pytest.raises(ConfigurationError, match="robot.reported='speeds': expected one of"):
        drive("robot=quadrotor_rotorpy", "method=afm_physics", **{"robot.reported": "speeds"})
