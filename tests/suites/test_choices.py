"""Every choice that a suite adds says what it is, and runs."""

from pathlib import Path

import numpy as np
import pytest

from afm_rl.missions import run

SUITES = Path(__file__).parents[2] / "benchmarks" / "suites"
FILES = sorted(SUITES.glob("*/conf/*/*.yaml"))
FLIGHT = "robot=quadrotor"
STILL = ["robot=inverted_pendulum", "cost=tracking", "cost.weights=[1,1,1,1]"]
STILL += [
    "~planner.temperature",
    "cost.action_weights=[1]",
    "cost.coordinates=[]",
    "cost.rest=null",
    "cost.in_keys=[]",
]
PARTNERS = {
    "planner=icem_lqr": STILL,
    "planner=law": ["robot=gusty_pendulum"],
    "updater=sysid": ["robot=inverted_pendulum", "robot.physics={length:[0.5,2.0]}"],
    "method=afm_sysid": ["robot=inverted_pendulum", "robot.physics={length:[0.5,2.0]}"],
    "planner=geometric": [FLIGHT],
    "planner=geometric_soft": [FLIGHT],
    "planner=raptor": ["robot=quadrotor_rotorpy_10ms"],
    "method=raptor": ["robot=quadrotor_rotorpy_10ms"],
    "method=geometric": [FLIGHT],
    "method=mass_estimator": [FLIGHT],
    "updater=mass": ["dynamics=oracle", FLIGHT],
}
NEEDS = {"actuator_inversion": ["dm_control"], "flight": ["foundation_policy", "rotorpy"]}


def name_of(path):
    return f"{path.parent.name}={path.stem}"


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_every_choice_runs(agent_of, path):
    suite, choice = path.parents[2].name, name_of(path)
    for package in NEEDS.get(suite, []):
        pytest.importorskip(package)
    results = run(agent_of(suite, choice, *PARTNERS.get(choice, []), "budget=5", "seeds=1"))
    assert results.missions["steps"].eq(4).all()
    assert np.isfinite(results.steps.to_numpy(dtype=float)).all()


def test_data_are_planned_with_the_robots_own_cost(agent_of):
    small = ["method=frozen_pe", "dynamics.members=2", "dynamics.hidden=[8,8]"]
    small += ["robot.data.rounds=[32,16]", "robot.data.fit.epochs=1", "planner.horizon=3"]
    agent = agent_of("actuator_inversion", "robot=inversion_double_integrator", *small)
    (training,) = agent.trainings
    assert len(training.train(False)["rewards"]) == 2  # mpc, which needs a quadratic cost
