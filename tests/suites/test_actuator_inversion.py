"""The Actuator Inversion Benchmark: its contexts, and worlds and rewards in them."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from actuator_inversion import actuator_inversion_task
from actuator_inversion.score import scores
from actuator_inversion.toys import COEFFICIENT, MASS, Coefficients, Sled

from afm_rl.envs import TaskEnv
from afm_rl.missions.task_robot import TaskRobot
from afm_rl.regimes import Physics, Schedule

TASKS = ("cartpole", "reacher_hard", "cheetah", "ball_in_cup")


@pytest.fixture(scope="module")
def bodies():
    pytest.importorskip("dm_control")
    return {name: actuator_inversion_task(name) for name in TASKS}


def stretched(task, length):
    row = tuple(Physics().encode({"length": length}).tolist())
    return task.world.step.models(np.array([row]))[0]


def factors(task, split):
    return [after.get("length", 1.0) for _, after in task.contexts[split]]


def test_splits_are_the_published_ones(bodies):
    pole = bodies["cartpole"]
    train, near, far = (0.5 * np.array(factors(pole, name)) for name in ("train", "in", "out"))
    assert train[[0, -1]] == pytest.approx([0.3, 0.85])
    assert near[[0, -1]] == pytest.approx([0.3055, 0.8445])
    assert far[[0, -1]] == pytest.approx([0.1, 2.0])
    assert not ((far > 0.3) & (far < 0.85)).any()
    signs = [after.get("gain_0", 1.0) for _, after in pole.contexts["out"]]
    assert len(signs) == 20 and set(signs) == {-1.0, 1.0}
    before, after = pole.contexts["in_reversed"][3]
    assert after == before | {"gain_0": -1.0}
    cup = bodies["ball_in_cup"]  # it has no reversed sign, but two parameters
    assert all(set(after) <= {"gravity", "length"} for _, after in cup.contexts["out"])
    assert len({after["gravity"] for _, after in cup.contexts["out"]}) == 20


@pytest.mark.parametrize("name", TASKS[:3])
def test_a_body_of_nominal_length_is_the_published_body(bodies, name):
    model, same = bodies[name].world.mjcf, stretched(bodies[name], 1.0 + 1e-12)
    for part in ("body_mass", "body_inertia", "body_pos", "geom_size", "geom_pos"):
        np.testing.assert_allclose(getattr(same, part), getattr(model, part), atol=1e-9)


def test_what_a_length_changes(bodies):
    pole = stretched(bodies["cartpole"], 2.0)
    assert pole.body("pole_1").ipos[2] == pytest.approx(1.0)
    assert pole.body("pole_1").mass == pytest.approx(0.1)
    arm = stretched(bodies["reacher_hard"], 1.5)
    assert arm.body("finger").pos[0] == pytest.approx(0.18)
    assert arm.body("hand").mass > bodies["reacher_hard"].world.mjcf.body("hand").mass
    leg = stretched(bodies["cheetah"], 0.5)
    assert leg.body("bshin").pos == pytest.approx([0.08, 0, -0.125])
    assert leg.body("fthigh").pos == pytest.approx([0.5, 0, 0])
    assert leg.geom("ffoot").size[1] == pytest.approx(0.035)
    assert leg.body_mass.sum() == pytest.approx(14.0)


def test_rewards_are_those_of_the_longer_body(bodies):
    mujoco = pytest.importorskip("mujoco")
    state = torch.tensor([0.3, 0.1, 0.2, *[0.1] * 6, 2.0, 0.3, -0.4, *[0.5] * 6]).double()
    model = stretched(bodies["cheetah"], 1.4)
    data = mujoco.MjData(model)
    data.qpos, data.qvel = state.numpy()[:9], state.numpy()[9:]
    mujoco.mj_forward(model, data)
    speed = data.sensor("torso_subtreelinvel").data[0]
    reward = bodies["cheetah"].reward_in(model)(state, torch.zeros(6), state)
    assert reward.item() == pytest.approx(speed / 10)
    reacher = bodies["reacher_hard"]
    arm, place = stretched(reacher, 1.5), torch.tensor([0.4, -0.8, 0.0, 0.0]).double()
    data = mujoco.MjData(arm)
    data.qpos = place.numpy()[:2]
    mujoco.mj_forward(arm, data)
    tip = torch.tensor(data.body("finger").xpos[:2])
    for gap, wanted in ((0.02, 1.0), (0.03, 0.0)):  # the radius is that of the task
        goal = reacher.goal_in(arm, tip + torch.tensor([gap, 0.0]))
        assert reacher.reward_in(arm)(place, torch.zeros(2), place, goal).item() == wanted


def test_missions_of_a_batch_have_bodies_of_their_own(bodies):
    task = bodies["reacher_hard"]
    env = TaskEnv(task, regime=TaskRobot(lambda: task, TaskEnv).regime, schedule=Schedule([]))
    rows = [env.mission(seed=3, regime=regime) for regime in ({}, {"length": 1.5})]
    start = env.reset(torch.stack(rows), set_state=False)
    assert torch.allclose(start["goal"][0], 1.5 * start["goal"][1])
    after = env.step(start.set("action", torch.ones(2, 2)))["next", "observation"]
    assert (after[0, 2:].abs() > after[1, 2:].abs()).all()  # a longer arm is heavier


@pytest.mark.parametrize(("at", "before"), [([], 0), ([0.5], 10)])
def test_a_flip_from_the_start_or_inside_the_episode(at, before):
    task = actuator_inversion_task("double_integrator", contexts=3, steps=20)
    task = replace(task, start=lambda seed: (torch.zeros(4), torch.zeros(0)))
    robot = TaskRobot(lambda: task, TaskEnv, schedule=Schedule(at))
    env = robot.env(regime=robot.regime, schedule=robot.schedule)
    found = robot.families["train_reversed"]["list"][1]
    mission = env.mission(seed=1, regime=found)
    assert env.simulation.changes_at(mission["mission"]).item() == before
    td, speeds = env.reset(mission, set_state=False), []
    for _ in range(20):
        td = env.step(td.set("action", torch.tensor([0.1, 0.1])))["next"]
        speeds.append(td["observation"][2].item())
    pushes = np.diff(speeds) / 0.01
    mass = -1 / task.contexts["train_reversed"][1][1]["gain_0"]
    assert pushes[-1] == pytest.approx(-1 / mass, abs=1e-3)
    assert pushes[0] == pytest.approx((1 if at else -1) / mass, abs=1e-3)


def test_the_double_integrator_starts_in_a_corner_and_pays_at_the_origin():
    task = actuator_inversion_task("double_integrator")
    starts = torch.stack([task.start(seed)[0] for seed in range(50)])
    assert (starts[:, :2].abs() >= 0.8).all() and (starts.abs() <= 1).all()
    assert starts[:, 0].sign().unique().tolist() == [-1, 1]
    near = torch.tensor([[0.06, 0.06, 1.0, 0.0], [0.08, 0.08, 0.0, 0.0]])
    assert task.reward(near, near[:, :2], near).tolist() == [1.0, 0.0]


def simulation(task, *chosen):
    robot = TaskRobot(lambda: task, TaskEnv, schedule=Schedule([]))
    env = robot.env(regime=robot.regime, schedule=robot.schedule)
    rows = torch.stack([env.mission(seed=seed, regime=regime) for seed, regime in chosen])
    return env, env.reset(rows, set_state=False)


def test_mass_and_friction_are_those_of_the_published_equations():
    task = actuator_inversion_task("double_integrator_friction")
    regimes = [{}, {"mass": 0.5, "friction": 2.0}, {"mass": 2.0, "gain_0": -1.0, "gain_1": -1.0}]
    env, td = simulation(task, *enumerate(regimes))
    force, start = torch.tensor([0.3, -0.4]), td["observation"]
    places, speeds = start.chunk(2, -1)
    after = env.step(td.set("action", force.expand(3, 2)))["next", "observation"]
    for row, regime in enumerate(regimes):
        mass, friction = regime.get("mass", 1.0), regime.get("friction", 1.0)
        pushed = regime.get("gain_0", 1.0) * force
        faster = speeds[row] * (1 - 0.1 * friction / mass) + pushed / mass * 0.1
        wanted = torch.cat([places[row] + 0.1 * speeds[row], faster]).clamp(-1, 1)
        torch.testing.assert_close(after[row], wanted)


def test_forces_that_undo_mass_and_friction():
    sled, state = Sled(), torch.tensor([0.2, 0.0, 0.5, -0.8])
    row, wanted = sled.encode({"mass": 0.7, "friction": 1.8}), torch.tensor([0.1, -0.3])
    force = sled.inverse(wanted, row, state, torch.tensor([-9.0]), torch.tensor([9.0]))
    torch.testing.assert_close(sled.apply(force, row, state), wanted)


def test_coefficients_are_those_of_the_published_equation():
    task = actuator_inversion_task("ode")
    generator = torch.Generator().manual_seed(3)
    actions = 2 * torch.rand(200, 2, generator=generator) - 1
    values = 20 * torch.rand(200, 2, generator=generator) - 10
    values[:3] = torch.tensor([[2.5, 2.5], [0.0, 0.0], [-10.0, 10.0]])
    regimes = [dict(zip(("c0", "c1"), row, strict=True)) for row in values.tolist()]
    env, td = simulation(task, *((seed, regime) for seed, regime in enumerate(regimes)))
    number = torch.complex(*actions.unbind(-1))
    rate = (values[:, 0] * number + values[:, 1] * number**2).real
    after = env.step(td.set("action", actions))["next", "observation"]
    wanted = td["observation"] + 0.01 * rate.unsqueeze(-1)
    torch.testing.assert_close(after, wanted, atol=1e-5, rtol=1e-5)
    same = Coefficients().apply(actions, torch.tensor([2.5, 2.5]), td["observation"])
    assert torch.equal(same, actions)


def test_contexts_of_the_toys_without_a_flip():
    for name, (inner, outer) in (("double_integrator_friction", MASS), ("ode", COEFFICIENT)):
        task = actuator_inversion_task(name)
        (family,) = task.changes.values()
        for split, beyond in (("in", False), ("out", True)):
            rows = [[after[key] for key in family.names] for _, after in task.contexts[split]]
            values = np.array(rows)
            inside = (values > inner[0]) & (values < inner[1])
            assert values.shape == (20, 2) and (inside != beyond).all()
            assert values.min() >= outer[0] and values.max() <= outer[1]
        before, after = task.contexts["in_reversed"][5]
        assert after == before | {"gain_0": -1.0, "gain_1": -1.0}


def test_the_ode_starts_in_the_unit_interval_and_pays_by_distance():
    task = actuator_inversion_task("ode")
    starts = torch.stack([task.start(seed)[0] for seed in range(50)])
    assert starts.min() < -0.8 and starts.max() > 0.8 and starts.abs().max() <= 1
    place = torch.tensor([[0.04], [-0.06], [0.15], [-0.3], [1.0], [2.1]])
    paid = task.reward(place, place, place)
    torch.testing.assert_close(paid, torch.tensor([1, 1 / 2, 1 / 3, 1 / 4, 0.05, 0]))


def test_scores_are_shares_of_what_all_methods_span_in_a_task():
    rows = pd.DataFrame({"method": ["nothing", "oracle"] * 4, "regime": ["in"] * 4 + ["out"] * 4})
    rows["return"] = [0, 10, 5, 10, -1, 99, 5, 10]
    rows["track"] = ["ode"] * 6 + ["cartpole"] * 2
    rows = rows.assign(scenario=rows["track"] + rows["regime"])
    found = scores(rows).set_index(["split", "method"])["score"]
    assert found["in", "nothing"] == pytest.approx((0.01 + 0.06) / 2)
    assert found["out", "oracle"] == 1
    unused = pd.DataFrame([dict(rows.iloc[0], regime="reversed") | {"return": 1e9}])
    assert scores(pd.concat([rows, unused])).equals(scores(rows))
