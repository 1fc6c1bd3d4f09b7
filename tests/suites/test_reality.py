"""Robots that differ from their model: what is drawn, and the tables."""

import gymnasium
import numpy as np
import pytest
import torch

pytest.importorskip("mujoco")


@pytest.mark.parametrize(
    ("name", "task"),
    [("half_cheetah", "HalfCheetah-v5"), ("walker2d", "Walker2d-v5"), ("hopper", "Hopper-v5")],
)
def test_a_nominal_robot_is_that_of_gymnasium(suite, name, task):
    robots = suite("robots")
    robot, env = robots.ROBOTS[name](), gymnasium.make(task)
    drawn = robots.DrawnRobots(robot, [(0, 3)])
    observation, _ = env.reset(seed=3)
    np.testing.assert_allclose(drawn.reset()[0][0], observation)
    for _ in range(4):
        action = robot.act(torch.from_numpy(observation)[None], torch.zeros(1)).numpy()
        observation, reward, terminated, _, _ = env.step(action[0])
        seen, rewards, fallen, _, _ = drawn.step(action)
        np.testing.assert_allclose(seen[0], observation, atol=1e-4)
        assert rewards[0] == pytest.approx(reward, abs=1e-3)
        assert fallen[0] == terminated


@pytest.mark.parametrize("name", ["half_cheetah", "arm", "ground_robot"])
def test_draws_differ_by_number_and_grow_with_the_level(suite, name):
    robots = suite("robots")
    robot = robots.ROBOTS[name]()
    drawn = robots.DrawnRobots(robot, [(0, 0), (1, 0), (2, 0), (1, 1), (1, 0)])
    drawn.reset()
    drawn.state = drawn.state[:1].expand(5, -1).clone()
    for _ in range(5):
        drawn.step(0.3 * robot.high.expand(5, -1).numpy())
    away = (drawn.state - drawn.state[0]).norm(dim=-1)
    assert 0 < away[1] < away[2]
    assert drawn.state[1].equal(drawn.state[4]) and not drawn.state[1].equal(drawn.state[3])
    read = (drawn.reading - drawn.state).abs().sum(-1)
    assert read[0] == 0 and read[2].item() == pytest.approx(2 * read[1].item())


def test_a_robot_that_has_fallen_stays_where_it_is(suite):
    robots = suite("robots")
    hopper = robots.ROBOTS["hopper"]()
    drawn = robots.DrawnRobots(hopper, [(1, 0)])
    drawn.reset()
    drawn.state[:, 2] = 1.0  # rad, its pitch
    _, _, fallen, _, _ = drawn.step(np.zeros((1, 3)))
    state = drawn.state
    drawn.step(np.ones((1, 3)))
    assert fallen.all() and drawn.state.equal(state)


def test_the_tables_say_what_a_fault_costs(suite, command, monkeypatch, tmp_path):
    draws = suite("draws")
    kinds = {"none": {}, "reversed": {"gain_0": -1.0, "gain_1": -1.0}, "late 3": {"delay": 3}}
    monkeypatch.setattr(draws, "faults", lambda size: kinds)
    said = command(
        "run", "--robots", "ground_robot", "--draws", "2", "--at", "10", "--after", "40",
        "--out", tmp_path,
    )  # fmt: skip
    rows = [line.strip("| ").split(" | ") for line in said.splitlines() if "| ground robot" in line]
    returns = {row[0]: [float(cell.split()[0]) for cell in row[1:]] for row in rows[:6]}
    alone, afm, before, online, exact = returns["ground robot, mild, reversed"]
    healthy = returns["ground robot, mild, none"][0]
    assert alone < 0.3 * healthy and min(afm, before, online, exact) > 0.8 * healthy
    assert len(list(tmp_path.glob("*.csv"))) == 5
    assert command(
        "run", "--robots", "ground_robot", "--draws", "2", "--at", "10", "--out", tmp_path
    )
