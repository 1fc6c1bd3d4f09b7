"""Policies of others in tasks whose actuators fail, at a small size."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("mujoco")
EXAMPLES = Path(__file__).parents[2] / "examples"
POLICIES = sorted((EXAMPLES / "policies" / "zoo").glob("*.safetensors"))


@pytest.fixture
def played(command, suite, tmp_path):
    """Run the suite's command; return what it said and its results."""

    def run(*arguments):
        said = command("run", "--out", tmp_path, "--episodes", "1", "--steps", "70", *arguments)
        return said, suite("run").read(tmp_path)

    return run


def test_a_reversal_is_undone_and_results_are_kept(played, tmp_path):
    asked = ["--policies", "pendulum_sac", "--faults", "none", "one reversed", "--steps", "60"]
    said, results = played(*asked, "--methods", "alone", "AFM")
    assert "pendulum_sac, AFM: 2 episodes" in said and (tmp_path / "zoo.png").is_file()
    after = results.pivot_table(index="method", columns="fault", values="after")
    healthy = after.at["alone", "none"]
    assert np.isclose(after.at["AFM", "none"], healthy, rtol=0.01)
    assert after.at["alone", "one reversed"] < healthy - 20
    assert after.at["AFM", "one reversed"] > after.at["alone", "one reversed"] / 2
    said, again = played(*asked, "--methods", "alone", "AFM", "truth")
    assert "AFM: 2 episodes" not in said and "truth: 2 episodes" in said
    after = again.pivot_table(index="method", columns="fault", values="after")
    assert len(again) == 6 and after.loc["truth"].min() > healthy - 5


def test_who_knows_the_truth_acts_as_the_healthy_policy(played):
    faults = ["none", "all reversed", "swapped pair", "late 4", "reversed and late 2"]
    asked = ["--policies", "hopper_trpo", "--methods", "truth", "alone", "--steps", "230"]
    _, results = played(*asked, "--faults", *faults)
    after = results.pivot_table(index="method", columns="fault", values="after").loc["truth"]
    assert np.allclose(after, after["none"], rtol=0.1) and results["survived"].any()


def test_recovered_is_to_be_no_worse_than_the_worst_healthy_window_but_for_a_tenth(suite):
    episodes, healthy = suite("episodes"), np.tile([0.8, 1.2], 200)[:, None]
    level = episodes.usual(healthy, window=10)
    assert level == pytest.approx(0.9)
    rewards = np.ones(300)
    assert episodes.recovered(rewards, level, 10) == 0
    rewards[:40] = 0.45
    assert episodes.recovered(rewards, level, 10) == 39  # one of the ten steps from then on
    rewards[200:] = 0.0
    assert episodes.recovered(rewards, level, 10) == np.inf


def test_shares_are_those_of_what_is_healthy(suite):
    rows = [("a", "none", "alone", 50.0), ("a", "dead", "AFM", 25.0)]
    rows += [("b", "none", "alone", -10.0), ("b", "all reversed", "alone", -110.0)]
    rows += [("b", "dead", "AFM", -60.0)]
    results = pd.DataFrame(rows, columns=["policy", "fault", "method", "after"])
    assert suite("show").shares(results)["share"].tolist() == [1.0, 0.5, 1.0, 0.0, 0.5]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("file", POLICIES, ids=lambda file: file.stem)
def test_every_policy_fits_its_task(suite, file):
    task = suite("task").Task(file)
    observation, _ = task.twin.reset(seed=0)
    action = task.act(observation[None])
    assert task.twin.action_space.contains(action[0]) and task.at in (40, 200)


def test_by_radio_the_newest_command_that_arrived_acts(suite):
    radio = suite("radio")
    task = suite("task").Task(POLICIES[[p.stem for p in POLICIES].index("pendulum_sac")])
    envs = radio.Radio(task.vector(2), [True, False])
    envs.reset(seed=[3, 3])
    ages = []
    for step in range(400):
        envs.step(np.full((2, 1), step / 1000, dtype=np.float32))
        assert envs.acting[1] == np.float32(step / 1000)
        ages.append(step - round(1000 * float(envs.acting[0, 0])))
    assert min(ages[13:]) == 3 and max(ages[13:]) <= 13
    assert np.median(ages[13:]) == 4  # the newest overtakes: sooner than the mean of 4.6
    held = np.diff(ages[13:])
    assert held.max() == 1 and held.min() < 0
