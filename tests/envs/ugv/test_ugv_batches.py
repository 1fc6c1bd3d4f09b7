"""A mission does not notice who else is in the batch."""

import pytest
import torch

from afm_rl.envs import UGVTrack

KEYS = ("pose", "reached", "goal", "regime", "reward", "done")
STEPS = 120


def fleet():
    """Return eleven regimes on two tracks with three seeds, as one batch."""
    env = UGVTrack(["ethz_1", "ethz_2"], process_noise=0.01)
    missions = [
        env.mission(track, seed, {"v_gain": gain, "omega_gain": 1 / gain})
        for track in (0, 1)
        for seed in range(3)
        for gain in (-2.5, -0.3, 0.7, 1.9)
    ]
    return torch.stack(missions)


def steer(data):
    """Return a policy's action: drive towards the goal, in closed form of the row."""
    away = data["goal"] - data["observation"][..., :2]
    turn = torch.atan2(away[..., 1], away[..., 0]) - data["observation"][..., 2]
    return torch.stack([turn.cos(), 2 * turn.sin()], -1)


def drive(missions, steps=STEPS, leave=None):
    """Run missions; after ``leave[0]`` steps keep only the rows ``leave[1]``."""
    env = UGVTrack(["ethz_1", "ethz_2"], process_noise=0.01)
    data = env.reset(missions, set_state=False)
    record = []
    for step in range(steps):
        if leave is not None and step == leave[0]:
            data = data[leave[1]]
        data["action"] = steer(data)
        env.step(data)
        record.append(data["next"].select(*KEYS).clone())
        data = env.step_mdp(data)
    return record


@pytest.fixture(scope="module")
def together():
    return drive(fleet())


@pytest.mark.parametrize("row", [0, 7, 23])
def test_a_row_equals_the_mission_alone(together, row):
    alone = drive(fleet()[row])
    for batch, single in zip(together, alone, strict=True):
        assert (batch[row] == single).all()
    assert int(single["reached"]) > 2  # something happened


def test_rows_that_leave_do_not_disturb_the_others(together):
    stay = torch.tensor([1, 2, 9, 20])
    record = drive(fleet(), leave=(40, stay))
    for batch, rest in zip(together[40:], record[40:], strict=True):
        assert (batch[stay] == rest).all()


def test_the_shape_of_the_batch_does_not_matter(together):
    shaped = drive(fleet().reshape(2, 3, 4), steps=20)
    for batch, other in zip(together, shaped, strict=False):
        assert (batch == other.reshape(-1)).all()


def test_a_locked_batch_gives_the_same_as_an_open_one():
    missions = fleet()
    settings = {"tracks": ["ethz_1", "ethz_2"], "process_noise": 0.01}
    locked = UGVTrack(**settings, batch_size=missions.batch_size, missions=missions)
    data, other = locked.reset(), UGVTrack(**settings).reset(missions, set_state=False)
    assert (data == other).all()
