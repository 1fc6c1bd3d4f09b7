"""Two robots share policy and faults; one of them is corrected."""

from pathlib import Path

import numpy as np
import pytest
import torch

from afm_rl.cli.play import main
from afm_rl.planning import StoredPolicy, save_policy
from afm_rl.play import World, make_robot

pytest.importorskip("mujoco")
LEGGED = Path(__file__).parents[2] / "benchmarks" / "suites" / "legged"
SMALL = str(LEGGED / "robots" / "small")


def go(world, steps):
    for _ in range(steps):
        world.step()


def test_a_reversed_cart_falls_unless_it_is_corrected():
    world = World(make_robot("cart_pole"))
    go(world, 5)
    alone, corrected = world.sides.values()
    assert sum(alone.rewards) == sum(corrected.rewards) > 0
    world.fail({"gain_0": -1.0})
    go(world, 160)
    assert alone.falls > 3 and corrected.falls <= 2  # before the reversal is believed
    _, executed, effect = np.array(corrected.commands).swapaxes(0, 1)
    np.testing.assert_allclose(executed[-20:], -effect[-20:], rtol=1e-6)
    world.push()
    world.reset()
    assert alone.falls == alone.steps == 0
    np.testing.assert_array_equal(alone.observation, corrected.observation)


@pytest.mark.parametrize("name", ["hopper", "pendulum", "ugv"])
def test_healthy_robots_do_the_same(name):
    world = World(make_robot(name))
    go(world, 5)
    alone, corrected = world.sides.values()
    assert alone.steps == corrected.steps == 5
    assert not corrected.info["afm"]["corrected"]
    if name != "ugv":  # whose planner draws its candidates
        assert alone.rewards == corrected.rewards
    world.push()


def test_a_robot_of_a_folder_has_faults_about_its_pose(monkeypatch):
    pytest.importorskip("onnxruntime")
    world = World(make_robot(SMALL))
    go(world, 5)
    alone, corrected = world.sides.values()
    assert alone.rewards == corrected.rewards  # both walk in step, by the clock of their own gait
    world.fail(world.robot.faults["offset .25 on one"])
    servo = next(int(name[5:]) for name in world.fault)
    go(world, 30)
    planned, executed, effect = np.array(corrected.commands)[-1]
    assert effect[servo] == pytest.approx(executed[servo] + 0.25, rel=1e-6)  # rad
    assert abs(effect - planned)[servo] < 0.1
    world.reset()
    assert alone.act.steps == corrected.act.steps == 0
    monkeypatch.chdir(Path(SMALL).parent)
    assert make_robot("./small").name == make_robot("small").name == "small"


@pytest.mark.parametrize(
    ("about", "arguments", "words"),
    [
        (None, ["--robot", "dog"], "--robot='dog'"),
        (None, ["--policy", "nothing.safetensors"], "no such file"),
        (None, ["--robot", "nowhere/go1"], "nowhere/go1.xml"),
        (None, ["--robot", "nowhere/dog"], "dog.json: no such file; docs/howto/play.md"),
        (None, ["--robot", SMALL, "--policy", "x.onnx"], "has its own policy; omit --policy"),
        (None, ["--port", "70000"], "--port=70000"),
        ({"id": "Pendulum-v1"}, ["--robot", "hopper"], "acts in Pendulum-v1; omit --robot"),
        ({"id": "Pendulum-v1"}, ["--robot", "ugv"], "ugv has a controller; omit --policy"),
        ({}, [], "id=None: expected a task of gymnasium"),
        ({"id": "this:Pendulum-v1"}, [], "expected a task"),  # gymnasium would import a module
        ({"id": "CartPole-v1"}, [], "neither a task of MuJoCo nor the pendulum"),
        ({"id": "Hopper-v5"}, [], "a policy of 3 observations and 1 actions; Hopper-v5 has (11,)"),
        ({"id": "Hopper-v5", "settings": {"xml_file": "x.xml"}}, [], "expected numbers, by name"),
        ({"id": "Pendulum-v1", "settings": [1]}, [], "expected numbers, by name"),
        ({"id": "Pendulum-v1", "settings": {"speed": 1}}, [], "Pendulum-v1 cannot be played"),
    ],
)
def test_mistakes_and_policies_that_do_not_fit_end_in_one_line(
    about, arguments, words, tmp_path, called
):
    policy = [] if about is None else ["--policy", stored(tmp_path, about)]
    done = called(main, "afm-rl-play", *policy, *arguments)
    assert done.status == 2 and words in done.err and done.err.count("\n") == 1


def test_a_policy_names_its_robot(tmp_path):
    file = stored(tmp_path, {"id": "Pendulum-v1", "settings": {"g": 5.0}})
    for robot in (make_robot(file=file), make_robot("pendulum", file)):
        assert robot.name == "Pendulum-v1" and robot.make().unwrapped.g == 5.0
    assert make_robot().name == "half_cheetah" and make_robot("ugv").name == "ugv"


def stored(folder, about):
    """A policy of three observations and one action."""
    box = torch.ones(1)
    policy = StoredPolicy([(torch.ones(1, 3), torch.zeros(1))], -box, box)
    save_policy(folder / "mine.safetensors", policy, about)
    return str(folder / "mine.safetensors")
