"""One mission's bad readings and plans: the others do not notice, and nothing is learned."""

import warnings

import numpy as np
import pytest
import torch
from harness import assert_same_tables
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import Transform

from afm_rl.errors import ConfigurationError, NonFiniteError
from afm_rl.missions import run

FLIGHT = ("robot=quadrotor", "dynamics=physics")
PLANNERS = {"mppi": (), "icem": ("planner=icem",), "cem": ("planner=cem",), "mpc": FLIGHT}
NAN = float("nan")


class Sensor(Transform):
    """Mission 0's readings are replaced, or kept back, at some steps."""

    def __init__(self, steps, value=None):
        super().__init__(in_keys=["observation"])
        self.steps, self.value = steps, value

    def _step(self, tensordict, next_tensordict):
        seen = next_tensordict["observation"].clone()
        if int(next_tensordict["step"][0]) - 1 in self.steps:
            seen[0] = tensordict["observation"][0] if self.value is None else self.value
        return next_tensordict.set("observation", seen)

    def _reset(self, tensordict, tensordict_reset):
        return tensordict_reset


def drive(agent, sensor=None):
    if sensor is not None:
        agent.env.insert_transform(0, sensor)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # plans without a finite return are announced
        return run(agent)


def of(table, mission):
    return table[table["mission"] == mission].drop(columns="seconds", errors="ignore")


@pytest.fixture
def three(make_agent, ring):
    def make(*overrides, **settings):
        track = {} if "robot=quadrotor" in overrides else {"tracks": ring}
        return make_agent(*overrides, **{**track, "seeds": 3, "budget": 8, **settings})

    return make


@pytest.mark.parametrize("planner", PLANNERS)
def test_a_reading_that_is_nan_is_survived_and_the_others_do_not_notice(three, planner):
    healthy = drive(three(*PLANNERS[planner]))
    faulty = drive(three(*PLANNERS[planner]), Sensor([2], NAN))
    for mission in (1, 2):
        assert_same_tables(of(faulty.steps, mission), of(healthy.steps, mission))
        assert_same_tables(of(faulty.missions, mission), of(healthy.missions, mission))
    assert faulty.missions["faults"].tolist() == [2, 0, 0]  # into the reading, and out of it
    first = of(faulty.steps, 0)
    assert len(first) == 8
    assert first["fault"].tolist() == [0, 0, 1, 1, 0, 0, 0, 0]
    executed = first.filter(like="executed_").to_numpy()
    assert np.isfinite(executed).all()


def test_a_policy_that_plans_nan(three):
    def spoilt(action, step):
        """Plan NaN for mission 0 at step 2."""
        if int(step[0]) == 2:
            action[0] = NAN
        return action

    agent, spoil = three(), TensorDictModule(spoilt, ["action", "step"], ["action"])
    agent.planner = TensorDictSequential(agent.planner, spoil)
    results = drive(agent)
    assert results.missions["faults"].tolist() == [1, 0, 0]
    first = of(results.steps, 0)
    assert first["planned_v"].isna().tolist() == [False, False, True] + [False] * 5
    assert first["executed_v"].iloc[2] == first["executed_v"].iloc[1]


def test_a_mission_with_a_fault_can_be_ended(three):
    results = drive(three("faults=skip"), Sensor([2], NAN))
    assert results.missions["steps"].tolist() == [2, 7, 7]
    assert results.missions["faults"].tolist() == [1, 0, 0]
    flight = drive(three(*FLIGHT, "faults=skip"), Sensor([2], NAN))
    assert flight.missions["finished"].tolist() == [False, True, True]


def test_or_the_run_can_be_ended(three):
    with pytest.raises(NonFiniteError, match=r"step 2: missions \[0\]: .* faults=hold continues"):
        drive(three("faults=raise"), Sensor([2], NAN))
    with pytest.raises(ConfigurationError, match="faults='ignore': expected one of hold, skip, r"):
        three(faults="ignore")


def test_a_frozen_sensor_teaches_nothing(three):
    changed = {"regimes": [{"v_gain": -1.0}], "robot.schedule.at": []}
    agent = three("method=rls", budget=9, **changed)
    seen, learn = [], agent.updater.forward

    def watch(td):
        before = agent.model.matrix[0].clone()
        out = learn(td)
        seen.append(torch.equal(before, agent.model.matrix[0]))
        return out

    agent.updater.forward = watch
    results = drive(agent, Sensor([3, 4, 5]))
    first = of(results.steps, 0)
    assert seen[3:7] == [True] * 4 and not any(seen[1:3] + seen[7:])
    assert first["loss"].isna().tolist() == [False] * 3 + [True] * 4 + [False] * 2
    assert first["fault"].tolist() == [0, 0, 0, 1, 1, 1, 1, 0, 0]
    assert results.missions["faults"].tolist() == [4, 0, 0]
