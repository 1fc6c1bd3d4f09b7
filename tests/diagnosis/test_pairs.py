"""The diagnosis from pairs of executed and effective actions."""

import numpy as np
import pytest
from simulate import explain


def commands(rows=40, size=7, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (rows, size))


def test_each_fault_is_named():
    u = commands()
    y = u * [-0.6, 1, 1, 0, 1, 1, 1]
    y[:, [1, 2]] = u[:, [2, 1]]
    y[:2, 4], y[2:, 4] = u[0, 4], u[:-2, 4]
    y[:, 5] += 0.3
    y[:, 6] += 0.4 * u[:, 0]
    said = str(explain(u, y, step=0.05)).splitlines()
    assert said == [
        "0: reversed, 60 % of the command",
        "1: follows the command of 2",
        "2: follows the command of 1",
        "3: does not answer its command",
        "4: 2 steps (0.1 s) late",
        "5: offset +0.3 (16 % of its range)",
        "6: takes in +40 % of the command of 0",
    ]


@pytest.mark.slow
def test_healthy_pairs_raise_no_alarm():
    generator, said = np.random.default_rng(0), []
    for seed in range(20):
        u = commands(seed=seed)
        y = u + 0.1 * generator.standard_normal(u.shape)
        said += [a.status for a in explain(u, y).actuators]
    assert said.count("healthy") > 0.8 * len(said) and said.count("cannot tell") < 0.2 * len(said)
    assert said.count("changed") + said.count("dead") <= 1  # of 140


def test_small_commands_tell_a_gain_where_nothing_disturbs():
    u = 0.05 + np.cumsum(0.01 * commands(size=1), axis=0)
    assert str(explain(u, 0.5 * u)) == "0: 50 % of the command"
    disturbed = 0.5 * u + 0.1 * np.random.default_rng(0).standard_normal(u.shape)
    assert explain(u, disturbed).actuators[0].status == "cannot tell"
