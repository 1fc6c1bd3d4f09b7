"""The ground robot: dynamics, regimes, rewards, ends and resets."""

import math

import pytest
import torch
from driving import act
from tensordict import TensorDict
from torchrl.envs import StepCounter, TransformedEnv

from afm_rl.dynamics import dubins_step
from afm_rl.envs import UGVTrack
from afm_rl.errors import ConfigurationError, NonFiniteError
from afm_rl.regimes import ActionGain


def quiet(**settings):
    return UGVTrack(process_noise=0.0, start_noise=0.0, **settings)


def test_the_action_is_bounded_per_axis():
    space = UGVTrack(batch_size=(2,), action_low=[-2, -3], action_high=[2, 4]).action_spec.space
    assert (space.low.tolist(), space.high.tolist()) == ([[-2, -3]] * 2, [[2, 4]] * 2)


def test_a_step_is_a_dubins_step_of_the_scaled_action():
    env = quiet(missions={"regime": [{"v_gain": -2.5, "omega_gain": 0.5}] * 3})
    start = env.reset()["pose"]
    # v is clamped to 1 before the gain and reaches 2.5 m/s after it
    after = act(env, env.reset(), [3.0, 1.0])
    torch.testing.assert_close(after["pose"], dubins_step(start, torch.tensor([-2.5, 0.5]), 0.2))
    torch.testing.assert_close(after["observation"], after["pose"])


def test_noise_has_the_scale_that_was_asked_for():
    env = UGVTrack(process_noise=0.01)
    data = env.reset(TensorDict(batch_size=[4000]))
    moved = act(env, data, [0.0, 0.0])["pose"] - data["pose"]
    torch.testing.assert_close(moved.std(0), torch.full((3,), 0.01), rtol=0.1, atol=0)


@pytest.mark.parametrize(("track", "first", "last"), [("ethz_1", 6, 28), ("ethz_2", 3, 16)])
def test_the_regime_acts_strictly_between_its_thresholds(track, first, last):
    env = quiet(tracks=(track,))
    n = int(env.course.counts[0])
    assert (first - 1) / n <= 0.15 < first / n
    assert (last - 1) / n <= 0.80 < last / n
    data = env.reset(env.mission(regime={"v_gain": -1.0}).expand(n), set_state=False)
    data["reached"] = torch.arange(n)
    data["pose"][:, :2] = 100.0  # far from every target: nothing more is reached
    after = act(env, data, [1.0, 0.0])
    active = torch.arange(n).ge(first) & torch.arange(n).lt(last)
    assert (after["regime_active"] == active).all()
    assert (after["regime"][:, 0] == torch.where(active, -1.0, 1.0)).all()
    forward = (after["pose"] - data["pose"])[:, 0] / env.course.starts[0, 2].cos() > 0
    assert (forward == ~active).all()


def test_the_next_target_becomes_the_goal_one_per_step():
    env = quiet(reach=10.0)
    data = env.reset()
    targets = env.course.targets[0]
    torch.testing.assert_close(data["goal"], targets[0])
    for reached in (1, 2, 3):
        data = env.step_mdp(env.step(data.set("action", torch.zeros(2))))
        assert data["reached"].item() == reached
        torch.testing.assert_close(data["goal"], targets[reached])


def test_the_reward_is_distance_gained_plus_targets_reached():
    env = quiet()
    data = env.reset(TensorDict(batch_size=[2]))
    data["reached"] = torch.tensor([0, 1])
    before = (data["pose"][1, :2] - env.course.targets[0, 1]).norm()
    after = act(env, data, [1.0, 0.0])
    gap = (after["pose"][1, :2] - env.course.targets[0, 1]).norm()
    torch.testing.assert_close(
        after["reward"][:, 0], torch.stack([torch.tensor(0.8), before - gap])
    )


def test_the_last_target_terminates_and_counts_no_further():
    env = quiet()
    data = env.reset()
    data["reached"] = torch.tensor(18)
    for _ in range(2):
        after = act(env, data, [0.0, 0.0])
        assert (after["reached"].item(), after["terminated"].item()) == (19, True)
        assert (after["done"].item(), after["truncated"].item()) == (True, False)
        data = env.step_mdp(data)
    assert after["reward"].item() == 0.0


def test_the_budget_truncates():
    env = quiet(max_steps=3)
    done = env.rollout(10)["next"]
    assert done["truncated"][:, 0].tolist() == [False, False, True]
    assert not done["terminated"].any()


def test_default_missions_broadcast_and_keep_what_reset_adds():
    env = UGVTrack(["ethz_1", "ethz_2"], missions={"track": 1, "regime": {"v_gain": -1.0}})
    given = TensorDict({"mission": {"seed": torch.tensor([5, 5])}}, [2])
    data = env.reset(given, set_state=False)
    assert data["mission", "track"].tolist() == [1, 1]
    assert data["mission", "seed"].tolist() == [5, 5]
    assert data["mission", "parameters"][:, 1, 0].tolist() == [-1, -1]
    assert (data["pose"][0] == data["pose"][1]).all()


def test_an_automatic_reset_repeats_the_mission():
    env = UGVTrack(["ethz_1", "ethz_2"], max_steps=4)
    missions = [env.mission(seed % 2, seed, {"v_gain": -float(seed)}) for seed in range(1, 4)]
    missions = torch.stack(missions)
    for wrapped in (env, TransformedEnv(env, StepCounter())):
        data = wrapped.rollout(
            10,
            tensordict=wrapped.reset(missions, set_state=False),
            auto_reset=False,
            break_when_any_done=False,
        )
        assert data["step"][0].tolist() == [0, 1, 2, 3] * 2 + [0, 1]
        for key in ("track", "seed"):
            assert (data["mission", key] == missions["mission", key].unsqueeze(-1)).all()
        assert (data["pose"][:, 4] != data["pose"][:, 0]).any(-1).all()
        assert (data["next", "step"][:, 3] == 4).all()


def test_an_automatic_reset_of_one_mission_does_not_touch_the_record_of_the_step():
    env = UGVTrack(batch_size=(2,), max_steps=3)
    data = env.reset()
    data["step"] = torch.tensor([0, 2])
    before, after = env.step_and_maybe_reset(env.rand_action(data))
    assert before["next", "step"].tolist() == [1, 3]
    assert before["next", "done"][:, 0].tolist() == [False, True]
    assert after["step"].tolist() == [1, 0]


def test_reset_without_a_step_before_falls_back_to_the_defaults():
    env = UGVTrack(max_steps=3)
    mask = TensorDict({"_reset": torch.ones(2, 1, dtype=torch.bool)}, [2])
    assert env.reset(mask)["mission", "seed"].tolist() == [0, 1]
    other = TensorDict({"_reset": torch.ones(3, 1, dtype=torch.bool)}, [3])
    assert env.reset(other)["mission", "seed"].tolist() == [0, 1, 2]


def test_missions_of_a_locked_batch_can_wait():
    env = UGVTrack(batch_size=(3,))
    data = env.reset()
    data["_step"] = torch.tensor([[True], [False], [True]])
    after = act(env, data, [1.0, 0.0])
    assert after["step"].tolist() == [1, 0, 1]
    assert (after["pose"][1] == data["pose"][1]).all()
    assert after["reward"][1].item() == 0.0
    env.rollout(3, break_when_any_done=False, break_when_all_done=True)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_broken_action_is_named(value):
    env = UGVTrack()
    data = env.reset(TensorDict(batch_size=[3]))
    data["action"] = torch.zeros(3, 2)
    data["action"][2, 1] = value
    with pytest.raises(NonFiniteError, match=r"`action` .* missions \[2\]"):
        env.step(data)


def test_a_step_before_the_reset_says_so():
    with pytest.raises(ConfigurationError, match="start with reset"):
        UGVTrack().step(TensorDict({"action": torch.zeros(2)}, []))


class Narrow(ActionGain):
    """Returns one component less than it was given."""

    def apply(self, action, *others):
        return action[..., :1]


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("tracks", ["ethz_1", "ethz_1"]),
        ("regime", Narrow(["gain"])),
        ("schedule", [0.1, 0.2]),
        ("action_low", (2.0, -1.0)),
        ("action_low", 1.0),
        ("action_high", (1.0, math.inf)),
        ("batch_size", (0,)),
        ("missions", TensorDict({}, [])),
        ("missions", {"trak": "ethz_2"}),
        ("dtype", torch.int64),
    ],
)
def test_a_setting_out_of_range_is_named(setting, value):
    with pytest.raises(ConfigurationError, match=setting):
        UGVTrack(**{setting: value})


def test_missions_have_to_broadcast():
    missions = UGVTrack().mission().expand(3)
    with pytest.raises(ConfigurationError, match="does not broadcast"):
        UGVTrack(batch_size=(2,), missions=missions)
    with pytest.raises(ConfigurationError, match="does not broadcast"):
        UGVTrack(missions=missions)
