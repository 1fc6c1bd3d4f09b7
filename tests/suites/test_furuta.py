"""The Furuta pendulum whose motor sign, length and tip mass are hidden, at a small size."""

import numpy as np
import pandas as pd
import pytest
import torch

pytest.importorskip("mujoco")


def test_the_equations_are_those_of_the_simulator(suite):
    plant, generator = suite("plant"), np.random.default_rng(0)
    plants = [plant.drawn(generator)._replace(sign=1) for _ in range(8)]
    starts = generator.uniform(-1, 1, (8, 4)) * [3, 3, 15, 15]
    world = plant.Simulated(plants, starts)
    before, voltages = world.states, torch.as_tensor(generator.uniform(-10, 10, (8, 1)))
    physics = torch.tensor([[p.length, p.tip] for p in plants], dtype=torch.float64)
    after = world.step(voltages, [0.0] * 8)
    same = plant.step(before, voltages, physics, substeps=25)
    torch.testing.assert_close(same, after, rtol=0, atol=1e-9)


def test_another_pendulum_keeps_angles_and_speeds(suite):
    plant = suite("plant")
    world = plant.Simulated([plant.Plant(0.3, 0.03, 1)] * 2, np.array([[0.1, 3.0, 1.0, 2.0]] * 2))
    kept = world.states
    for row, sign in enumerate((-1, 1)):
        world.change(row, plant.Plant(0.2, 0.03, sign))
    assert torch.equal(world.states, kept)
    after = world.step(torch.tensor([[-1.0], [1.0]]), [0.0, 0.0])
    assert torch.equal(after[0], after[1]) and not torch.equal(after, kept)
    pushed = world.step(torch.tensor([[-1.0], [1.0]]), [0.0, 0.3])
    assert pushed[1, 3] > pushed[0, 3] + 1


def test_a_reversed_motor_and_the_body_are_found_from_a_cold_start(command, tmp_path):
    words = ["--methods", "iCEM+LQR", "--parts", "A", "--runs", "8", "--steps", "120"]
    command("run", *words, "--out", tmp_path)
    (file,) = tmp_path.glob("*.csv")
    written, ups = file.stat().st_mtime_ns, pd.read_csv(file)["up"]
    assert len(ups) == 8 and np.isfinite(ups[4:]).all()  # these motors are reversed
    command("run", *words, "--out", tmp_path)
    assert file.stat().st_mtime_ns == written


def test_recovery_is_to_stay_up_for_a_second(suite):
    recovery = suite("run").recovery
    angles = np.r_[np.zeros(30), np.ones(10), np.zeros(19), 1.0, np.zeros(20)]
    assert recovery(angles, 0) == 0 and recovery(angles, 30) == pytest.approx(1.5)
    assert recovery(angles[:70], 30) == np.inf
