"""The diagnosis from pairs of executed and effective actions."""

import numpy as np
import torch
from harness import refused

from afm_rl.diagnosis import explain


def commands(rows=40, size=7, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (rows, size))


def test_each_fault_is_named():
    u = commands()
    y = u * [-0.6, 1, 1, 0, 1, 1, 1]
    y[:, [1, 2]] = u[:, [2, 1]]
    y[2:, 4] = u[:-2, 4]
    y[:, 5] += 0.3
    y[:, 6] += 0.4 * u[:, 0]
    said = str(explain(torch.tensor(u), torch.tensor(y), step=0.05)).splitlines()
    assert said == [
        "0: reversed, 60 % of the command",
        "1: follows the command of 2",
        "2: follows the command of 1",
        "3: does not answer its command",
        "4: 2 steps late",
        "5: offset +0.3 (16 % of its range)",
        "6: takes in +40 % of the command of 0",
    ]


def test_healthy_pairs_raise_no_alarm():
    generator = np.random.default_rng(0)
    alarms = 0
    for seed in range(60):
        u = commands(seed=seed)
        y = u + 0.1 * generator.standard_normal(u.shape)
        alarms += sum(a.status != "healthy" for a in explain(u, y).actuators)
    assert alarms <= 2  # of 420


def test_only_the_newest_regime_counts():
    u = commands()
    y = u.copy()
    y[25:] *= -1
    assert {a.sentence[3:] for a in explain(u, y).actuators} == {"reversed"}


def test_nothing_is_said_of_commands_that_do_not_change():
    u = commands(size=2)
    u[:, 1] = 0.3
    assert [a.status for a in explain(u, u).actuators] == ["healthy", "cannot tell"]
    assert [a.status for a in explain(u[:5], u[:5]).actuators] == ["cannot tell"] * 2


def test_unsure_pairs_count_little():
    u = commands(size=1)
    y, std = u.copy(), np.full_like(u, 0.01)
    y[::4], std[::4] = 3.0, 4.0
    assert explain(u, y, std=std).healthy


@refused(
    (commands(30), None, "one shape"),
    (commands(), ["a"], "expected 7"),
)
def test_shapes_that_do_not_fit(effective, names):
    explain(commands(), effective, names)
