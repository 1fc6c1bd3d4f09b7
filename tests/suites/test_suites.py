"""A smoke test of each suite: what it defines, or one run of its command, at a small size."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image
from tensordict import TensorDict

from afm_rl.comparison.episodes import play
from afm_rl.dynamics import MuJoCoDynamics, Quadrotor
from afm_rl.envs import Circle, CrazyflieTrack, TaskEnv
from afm_rl.errors import ConfigurationError
from afm_rl.learning import GaussianNLLLoss
from afm_rl.missions.task_robot import TaskRobot
from afm_rl.planning import GoalDistance, PlanningEnv
from afm_rl.regimes import Physics, Schedule
from afm_rl.spaces.airframe import QuadrotorBody

ROOT = Path(__file__).parents[2]
BODY = QuadrotorBody()


def test_actuator_inversion_has_the_published_contexts_and_equations():
    from actuator_inversion import actuator_inversion_task

    task = actuator_inversion_task("double_integrator_friction")
    before, after = task.contexts["in_reversed"][5]
    assert after == before | {"gain_0": -1.0, "gain_1": -1.0}
    robot = TaskRobot(lambda: task, TaskEnv, schedule=Schedule([]))
    env = robot.env(regime=robot.regime, schedule=robot.schedule)
    regimes = [{}, {"mass": 0.5, "friction": 2.0}, {"mass": 2.0, "gain_0": -1.0, "gain_1": -1.0}]
    rows = [env.mission(seed=seed, regime=regime) for seed, regime in enumerate(regimes)]
    td = env.reset(torch.stack(rows), set_state=False)
    force = torch.tensor([0.3, -0.4])
    places, speeds = td["observation"].chunk(2, -1)
    after = env.step(td.set("action", force.expand(3, 2)))["next", "observation"]
    for row, regime in enumerate(regimes):
        mass, friction = regime.get("mass", 1.0), regime.get("friction", 1.0)
        pushed = regime.get("gain_0", 1.0) * force
        faster = speeds[row] * (1 - 0.1 * friction / mass) + pushed / mass * 0.1
        expected = torch.cat([places[row] + 0.1 * speeds[row], faster]).clamp(-1, 1)
        torch.testing.assert_close(after[row], expected)


def test_double_pendulum_interruptions_are_those_of_the_board(suite):
    board, plant = suite("board"), suite("plant")
    moved = []

    class Recorder:
        def restart(self, rows):
            moved.append(rows.tolist())

    interrupt = board.Interruptions([777], Recorder())
    random = np.random.RandomState(777)  # numpy's generator, in the order of the definition
    goal = random.uniform(0.0, 2 * np.pi, (151, 4))[0, :2] - np.pi
    assert abs(interrupt.starts[0, 0] * plant.DT - 3.75 - 2 * (random.rand(15)[0] - 0.5)) < 0.002
    assert interrupt.starts.diff(dim=1).min() * plant.DT > 1.75
    first, command = int(interrupt.starts[0, 0]), torch.ones(1, 2, dtype=torch.float64)
    hanging = torch.zeros(1, 4, dtype=torch.float64)
    assert interrupt(command, hanging, first - 1) is command and not moved
    for step, derivative in ((first, 1000 * goal), (first + 99, 0 * goal)):
        torque = interrupt(command, hanging, step)[0]
        assert torque.tolist() == pytest.approx((10 * goal + derivative).clip(-6, 6), abs=0.01)
        assert moved.pop() == [True]
    torch.testing.assert_close(plant.height(torch.tensor(plant.GOAL)), torch.tensor(0.5))


def test_double_pendulum_of_the_board_swings_up(command, tmp_path):
    words = ["--robots", "pendubot", "--seeds", "1", "--steps", "800", "--out", tmp_path]
    assert "| MPC+AFM, as published | 0." in command("board", *words)
    up = pd.read_csv(tmp_path / "board.pendubot.csv").groupby("plant")["up"].min()
    assert up["as published"] > 0.1


def test_double_pendulum_motors_are_those_of_a_log(command, tmp_path):
    folder = tmp_path / "data/experiment_records/design_C.0/20220914/1_acrobot_lqr_video"
    folder.mkdir(parents=True)
    log = pd.read_csv(ROOT / "examples" / "real_logs" / "double_pendulum_lqr.csv")
    names = {"t": "time", "command.elbow": "tau_con2", "response.elbow": "tau_meas2"}
    log.rename(columns=names).to_csv(folder / "trajectory.csv", index=False)
    shown = command("motors", "--data", tmp_path)
    assert "| acrobot, LQR (C.0) | 1/1 | 0.88 | 2.9 | 3.2 |" in shown
    assert "| acrobot, TVLQR (C.0) | 0/0 | – |" in shown


def test_flight_a_previewed_circle_is_followed_to_millimetres():
    from flight.geometric import GeometricController

    planner = GeometricController(PlanningEnv(Quadrotor(), GoalDistance(), *BODY.bounds))
    preview = {"horizon": 1, "preview": True, "start": "moving", "batch_size": (1,)}
    env = CrazyflieTrack([Circle(2.0, 0.8)], **preview)
    with torch.no_grad():
        flown = env.rollout(100, planner, tensordict=env.reset(), auto_reset=False)
    assert flown["next", "square_error"].mean() < 2e-5  # m^2


def test_furuta_physics_are_found_whatever_the_motors_do():
    from furuta.identifier import PhysicsIdentifier

    pole = """<mujoco><option timestep="0.01"/><worldbody>
    <body name="cart"><joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/>
      <body name="pole"><joint name="turns" type="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 1" size=".01" mass=".2"/>
    </body></body></worldbody>
    <actuator><motor joint="x" ctrlrange="-10 10" gear="10"/></actuator></mujoco>"""
    model = MuJoCoDynamics(pole, frame_skip=4, noise_std=1e-3)
    model.expand_(3)
    ranges = {"length": [0.5, 1.5]}
    updater = PhysicsIdentifier(GaussianNLLLoss(model), ranges=ranges, scale=[10.0], count=11)
    updater.start(TensorDict({}, [3]))
    rows = torch.stack([Physics().encode({"length": length}) for length in (0.7, 1.4, 1.0)])
    state, gains = torch.tensor([0.0, 0.2, 0.0, 0.0]).repeat(3, 1), torch.tensor([1.0, -1.0, 0.3])
    for _ in range(8):
        action = 10 * torch.rand(3, 1) - 5
        with model.assuming(rows):
            after = model(state, gains.unsqueeze(-1) * action)
        td = TensorDict({"observation": state, "action": action}, [3])
        updater(td.set(("next", "observation"), after))
        state = after
    torch.testing.assert_close(updater.physics["length"], torch.tensor([0.7, 1.4, 1.0]))


def test_gusts_the_oracle_undoes_the_mean_of_the_wind():
    from gusts.pendulum import Gusts, steer, winds

    row, state = Gusts().encode(winds(3, 1)[0]), torch.tensor([0.4, -1.0])
    low, high = torch.tensor([-20.0]), torch.tensor([20.0])
    torque = Gusts().inverse(steer(state), row, state, low, high)
    torch.testing.assert_close(Gusts().apply(torque, row, state), steer(state))


def test_legged_the_film_shows_which_robot_falls(command, tmp_path):
    pytest.importorskip("onnxruntime")
    words = ["--fault", "late 2", "--at", "0.1", "--seconds", "0.4", "--out", tmp_path / "film.gif"]
    assert "fell: []" in command("film", *words)
    with Image.open(tmp_path / "film.gif") as pictures:
        assert pictures.n_frames == 6


def test_legged_a_corrected_robot_of_servos_walks_on(suite):
    pytest.importorskip("onnxruntime")
    robots = ROOT / "benchmarks" / "suites" / "legged" / "robots"
    small = suite("robot").Robot(robots, "small")
    faults = [small.faults[name] for name in ("one reversed", "swapped pair", "late 2")]
    alone, corrected, informed = (
        -play(small.robot, small.begin, method, faults, [0] * 3, small.at, 140).rewards[90:].mean(0)
        for method in ("none", "AFM", "oracle")
    )
    assert (corrected[:2] < 0.6 * alone[:2]).all()
    assert (informed[:2] < 1.02 * corrected[:2]).all()
    assert (np.array([corrected, informed])[:, 2] < 1.2 * alone[2]).all()  # it hardly matters here


def test_legged_servos_with_several_inputs_are_refused(suite, tmp_path):
    pytest.importorskip("onnxruntime")
    for file in (ROOT / "benchmarks" / "suites" / "legged" / "robots").glob("small*"):
        shutil.copy(file, tmp_path)
    file = tmp_path / "small.xml"
    file.write_text(file.read_text().replace("<position name", '<pid kp="9" name', 1))
    with pytest.raises(ConfigurationError, match=r"small\.xml: expected position servos of one in"):
        suite("robot").Robot(tmp_path, "small")


def test_real_healthy_arms_are_not_accused_and_three_grounds_are_drawn():
    from real.grounds import Log, draw, one_drive
    from real.verdicts import accused

    assert not accused(6, size=2, episodes=4)
    log = one_drive()
    parts = (getattr(log, name)[:24] for name in ("command", "response", "seconds"))
    upper, _ = draw(Log(log.names, *parts)).axes
    assert {text.get_text() for text in upper.texts} == {"asphalt", "gravel", "ice"}


def test_safety_every_situation_has_an_effect_on_one_of_the_robots(suite):
    batches, worlds = suite("batches"), suite("worlds")
    for kinds, table in ((worlds.WORLDS, worlds.SITUATIONS), (worlds.ACTUATED, worlds.ACTUATORS)):
        situations = [{**rules, "box": 0} for rules in table.values()]
        robots = [make() for name, make in kinds.items() if name != "30 servos"]
        costs = torch.stack([batches.play(world, situations, 1) for world in robots])
        assert costs.isfinite().all()
        changed = (costs != costs[:, :1]).any(0).flatten().tolist()
        silent = [name for name, moved in zip(table, changed, strict=True) if not moved]
        assert {name.split()[-1].strip(":") for name in silent} == {"healthy"}


def test_safety_a_fault_that_suits_the_plans_is_no_measure(suite):
    judge = suite("run").judge
    for healthy, alone, corrected, verdict in (
        (1.0, 2.0, 1.2, "better"),
        (1.0, 1.0, 1.2, "worse"),
        (1.3, 1.0, 1.2, ""),
    ):
        costs = {"healthy": healthy, "without AFM": alone, "AFM": corrected}
        assert judge(pd.DataFrame(costs, index=range(3)))[""] == verdict


def test_zoo_a_reversal_is_undone_and_results_are_kept(suite, command, tmp_path):
    words = ["--out", tmp_path, "--episodes", "1", "--policies", "pendulum_sac", "--steps", "60"]
    words += ["--faults", "none", "one reversed", "--methods", "without AFM", "AFM"]
    assert "pendulum_sac, AFM: 2 episodes" in command("run", *words)
    results = pd.concat(map(pd.read_csv, tmp_path.glob("*.csv")))
    after = results.pivot_table(index="method", columns="fault", values="after")
    healthy = after.at["without AFM", "none"]
    assert np.isclose(after.at["AFM", "none"], healthy, rtol=0.01)
    assert after.at["without AFM", "one reversed"] < healthy - 20
    assert after.at["AFM", "one reversed"] > after.at["without AFM", "one reversed"] / 2
    shown = command("run", *words, "oracle")
    assert "AFM: 2 episodes" not in shown and "oracle: 2 episodes" in shown
