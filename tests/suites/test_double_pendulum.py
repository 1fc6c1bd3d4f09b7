"""RealAIGym's robustness V2, rebuilt: its definitions, and a robot that swings up."""

import pandas as pd
import pytest
import torch


@pytest.fixture
def runs(suite):
    return suite("runs").runs_of(torch.Generator().manual_seed(0))


def energy(plant, state, p):
    """Kinetic energy by velocities of both centres of mass; the I are about the joints."""
    q1, q2, v1, v2 = state.unbind(-1)
    first = 0.5 * p.I1 * v1**2
    across = plant.LENGTH * v1 * p.r2 * (v1 + v2) * q2.cos()
    second = 0.5 * (p.m2 * (plant.LENGTH * v1) ** 2 + p.I2 * (v1 + v2) ** 2) + p.m2 * across
    height = p.m1 * p.r1 * q1.cos() + p.m2 * (plant.LENGTH * q1.cos() + p.r2 * (q1 + q2).cos())
    return first + second - plant.GRAVITY * height


def test_without_friction_and_torque_energy_stays(suite):
    plant, state = suite("plant"), torch.randn(20, 4, dtype=torch.float64)
    before = energy(plant, state, plant.Physics())
    for _ in range(200):
        state = plant.step(state, torch.zeros(20, 2, dtype=torch.float64))
    torch.testing.assert_close(energy(plant, state, plant.Physics()), before, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("robot", "joint"), [("acrobot", 1), ("pendubot", 0)])
def test_torque_does_work_at_the_driven_joint(suite, robot, joint):
    plant, state = suite("plant"), torch.randn(20, 4, dtype=torch.float64)
    torque = torch.zeros(20, 2, dtype=torch.float64)
    torque[:, joint] = 3.0
    power = torch.func.jvp(
        lambda x: energy(plant, x, plant.Physics()),
        (state,),
        (plant.rates(state, torque, plant.Physics()),),
    )[1]
    torch.testing.assert_close(power, 3.0 * state[:, 2 + joint])
    assert plant.DRIVEN[robot] == joint


def test_each_parameter_has_21_values_and_all_else_is_nominal(suite, runs):
    nominal = suite("plant").Physics()._asdict()
    ends = {"Ir": [0, 1e-4], "b1": [-0.1, 0.1], "b2": [-0.1, 0.1]}
    ends |= {"cf1": [-0.2, 0.2], "cf2": [-0.2, 0.2], "m1": [nominal["m1"]] * 2}
    ends |= {n: [0.75 * nominal[n], 1.25 * nominal[n]] for n in ("r1", "r2", "m2", "I1", "I2")}
    physics = runs.physics._asdict()
    for name, values in physics.items():
        assert [values.min(), values.max()] == pytest.approx(ends[name])
        assert len(values.unique()) in ((1,) if name == "m1" else (21, 22))  # and the nominal one
    values = torch.stack([*physics.values()], -1)
    counts = (values != values.new_tensor([*nominal.values()])).sum(-1)
    assert counts.max() == 1
    assert sorted(runs.delay.unique().tolist()) == list(range(21))
    for name, most in (("velocity_noise", 0.5), ("torque_noise", 1.1), ("response", 2.0)):
        values, times = getattr(runs, name).unique(return_counts=True)
        assert values.max() == most
        assert (len(values), times[-1]) == ((21, 10) if "noise" in name else (22, 1))


def test_fifty_runs_have_three_pushes_apart(suite, runs):
    pushed = runs.pushes[:, [c == "pushes" for c in runs.column]]
    assert pushed.shape[1] == 50
    assert runs.pushes.count_nonzero(0).bool().sum() == 50
    strong = pushed.abs() > 0.4
    begins = (strong[1:] & ~strong[:-1]).sum(0)
    assert begins.max() == 3
    assert begins.double().mean() > 2.7  # the weakest hardly reach that
    assert pushed.abs().max() <= 5.0
    assert pushed[:400].abs().max() < 0.1  # a second of rest at the beginning


def test_a_run_with_noise_counts_by_its_majority(suite, runs):
    shares = suite("runs").shares
    noisy = torch.tensor([c == "torque noise" for c in runs.column]).nonzero().flatten()
    success = torch.zeros(len(runs.column), dtype=torch.bool)
    success[noisy[:15]] = True  # ten of the least noise, half of the next
    assert shares(runs, success)["share"]["torque noise"] == pytest.approx(1 / 21)
    success[noisy[15]] = True
    assert shares(runs, success)["share"]["torque noise"] == pytest.approx(2 / 21)


def test_a_delayed_state_is_that_of_so_many_steps_ago(suite, runs):
    first, seen = runs.column.index("delay"), []

    def push(state, step):
        seen.append(state)
        return torch.full_like(state[:, 0], 2.0)

    suite("runs").play("pendubot", runs, push, torch.Generator(), 60)
    for delay in (1, 7, 20):
        torch.testing.assert_close(seen[50][first + delay], seen[50 - delay][first])


def test_what_the_planner_does_nominally_can_be_tracked(suite, runs):
    act = suite("controllers").Tracking("pendubot", *suite("run").swing_up("pendubot", None))
    end = suite("runs").play("pendubot", runs, act, torch.Generator().manual_seed(0))
    share = suite("runs").shares(runs, suite("runs").upright(end))["share"]
    assert share["torque response"] > 0.8 and 0.2 < share["delay"] < 0.6


def test_a_row_is_kept_and_printed_again(command, tmp_path):
    words = ["--robots", "acrobot", "--methods", "MPC+AFM+positions"]
    words += ["--repeats", "1", "--steps", "12", "--out", tmp_path]
    first = command("run", *words)
    (file,) = tmp_path.glob("*.csv")
    assert len(pd.read_csv(file)) == 344
    assert command("run", *words) == first
