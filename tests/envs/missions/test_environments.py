"""What holds for every environment of missions: drives, flights, and other people's tasks."""

from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from driving import drive
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

import afm_rl  # noqa: F401  registers the environments
from afm_rl.envs import (
    Circle,
    CrazyflieTrack,
    Hover,
    RotorPyTrack,
    TaskEnv,
    UGVTrack,
    gymnasium_task,
)
from afm_rl.regimes import (
    ActionGain,
    Compose,
    Delay,
    GainNoise,
    Patches,
    Schedule,
    flight_regimes,
)

CAR = Compose([Delay(), ActionGain(["v_gain", "omega_gain"]), Patches(), GainNoise()])
FLEET = Compose([Delay(), GainNoise(), flight_regimes()])
SENSORS = {"sensor_noise": 0.01, "start_noise": 0.1}
MADE = {
    "a drive": (UGVTrack, {"max_steps": 3}),
    "a drive with a past": (UGVTrack, {"regime": CAR, "max_steps": 3, "missions": {"ramp": 2}}),
    "a flight": (CrazyflieTrack, {"duration": 0.15, "substeps": 2}),
    "a flight with a past": (
        CrazyflieTrack,
        {**SENSORS, "duration": 0.15, "substeps": 2, "trace": True, "regime": FLEET},
    ),
    "a flight of RotorPy": (RotorPyTrack, {"duration": 0.1, "substeps": 1, "trace": True}),
    "a task": (partial(TaskEnv, gymnasium_task("Pendulum-v1")), {"max_steps": 3}),
}


def made(name, **more):
    if "RotorPy" in name:
        pytest.importorskip("rotorpy")
    kind, settings = MADE[name]
    return kind(**{**settings, **more})


@pytest.mark.parametrize(
    ("batch", "schedule", "dtype"),
    [
        ((), None, torch.float32),
        ((4,), Schedule([]), torch.float64),
        ((2, 3), Schedule([1, 2], by="step"), torch.float32),
    ],
    ids=["alone", "a batch", "two dimensions"],
)
@pytest.mark.parametrize("name", MADE)
def test_specs_hold(name, batch, schedule, dtype):
    env = made(name, batch_size=batch, schedule=schedule, dtype=dtype)
    check_env_specs(env, break_when_any_done="both")
    data = env.rollout(2)
    assert {x.dtype for x in data.values(True, True) if x.is_floating_point()} == {dtype}
    assert ("past" in data.keys()) == ("past" in name)


def run(env, data, steps, first=0):
    """Let all missions act alike; return what each step led to."""
    space = env.full_action_spec_unbatched["action"].space
    shares = 0.5 + 0.1 * torch.sin(1.0 + torch.arange(first, first + steps)).unsqueeze(-1)
    return drive(env, data, space.low + shares * (space.high - space.low))


REGIMES = {
    "a drive with a past": [
        *({"delay": 1, "gain_noise": 0.4}, {"patch_v_gain": -1.0}, {"gain_noise": 0.2}),
    ],
    "a flight with a past": [{"mass": 0.5, "delay": 1}, {"gain_noise": 0.2, "wind_x": 1.0}, {}],
    "a flight of RotorPy": [{"mass": 0.5}, {"motor_1": 0.9}, {"wind_x": 3.0}],
}
LONG = {"max_steps": 99, "schedule": Schedule([1], by="step")}


@pytest.mark.parametrize("name", REGIMES)
def test_a_mission_is_the_same_alone_as_in_any_batch_and_after_a_stop(name):
    env, regimes = made(name, **LONG), REGIMES[name]
    near = {"rtol": 1e-5, "atol": 1e-6} if "RotorPy" in name else {"rtol": 0, "atol": 0}
    missions = torch.stack([env.mission(0, k, regimes[k % 3]) for k in range(6)])
    numbers = torch.random.get_rng_state()

    def runs(missions, steps=4):
        env.set_seed(0)
        return run(env, env.reset(missions, set_state=False), steps)

    together = runs(missions)
    torch.testing.assert_close(runs(missions.reshape(2, 3)).reshape(4, 6), together, **near)
    for row in (0, 5):
        torch.testing.assert_close(runs(missions[row]), together[:, row], **near)
    half, streams = runs(missions, 2)[-1], env.state_dict()
    for stay in (torch.arange(6), torch.tensor([2, 0])):  # as they were, and when some have left
        other = made(name, **LONG)
        other.load_state_dict(streams)
        rest = run(other, half.select(*env.observation_spec.keys())[stay], 2, first=2)
        torch.testing.assert_close(rest["pose"], together["pose"][2:, stay], **near)
    assert torch.random.get_rng_state().equal(numbers)


@pytest.mark.parametrize("name", ["a drive with a past", "a flight with a past"])
def test_a_mission_goes_on_from_a_given_state(name):
    quiet = {"start_noise": 0.0, **LONG}
    quiet |= {"process_noise": 0.0} if "drive" in name else {"sensor_noise": 0.0}
    env = made(name, **quiet, missions={"regime": {"delay": 2}, "ramp": 3})
    whole = run(env, env.reset(), 6)
    middle = whole[2].select(*env.state_spec.keys())
    rest = run(env, env.reset(middle, set_state=True), 3, first=3)
    assert (rest["pose"] == whole["pose"][3:]).all() and (rest["past"] == whole["past"][3:]).all()
    assert env.reset(middle, set_state=False)["step"].item() == 0
    fresh = env.reset(middle.select("pose", "mission"), set_state=True)
    assert fresh["past"].eq(0).all() and (fresh["pose"] == middle["pose"]).all()


@pytest.mark.parametrize("name", ["a drive with a past", "a flight with a past", "a task"])
def test_a_partial_reset_leaves_the_other_missions_alone(name):
    env = made(name, batch_size=(3,), max_steps=99)
    data = env.step_mdp(env.rand_step(env.reset()))
    held = data.clone()
    data["_reset"] = torch.tensor([[False], [True], [False]])
    after = env.reset(data, set_state=False)
    assert after["step"].tolist() == [1, 0, 1]
    for key in ("pose", "mission", *(["past"] if "past" in name else [])):
        assert (after[key][[0, 2]] == held[key][[0, 2]]).all()
    assert "past" not in name or not after["past"][1].any()


CHANGES = [{}, {"v_gain": 0.5}, {"delay": 1}, {"gain_noise": 0.3}]
FLOWN = {"regime": [{}, {"mass": 0.5}, {"mass": 4 / 3}], "ramp": 1}
GYMS = {
    "UGVTrack": (
        {"family": CAR, "regime": CHANGES, "schedule": [0.0, 0.06, 0.15], "ramp": 2},
        lambda: UGVTrack(
            regime=CAR,
            schedule=Schedule([0.0, 0.06, 0.15]),
            missions={"regime": CHANGES, "ramp": 2},
        ),
    ),
    "CrazyflieTrack": (
        {"reference": Circle(1.0), "times": [0.1, 0.3], "duration": 0.5, **FLOWN, **SENSORS},
        lambda: CrazyflieTrack(
            Circle(1.0), schedule=[0.1, 0.3], duration=0.5, missions=FLOWN, **SENSORS
        ),
    ),
}


@pytest.mark.parametrize("name", GYMS)
def test_gymnasiums_environment_is_the_native_one(name):
    settings, make = GYMS[name]
    env, native = gymnasium.make(f"afm_rl/{name}-v0", **settings), make()
    native.set_seed(3, static_seed=True)
    (observation, info), data, active = env.reset(seed=3), native.reset(), []
    for step in range(10):
        np.testing.assert_array_equal(observation[:3], data["observation"][:3].numpy())
        action = 0.3 * env.action_space.high
        observation, reward, terminated, truncated, info = env.step(action)
        after = native.step(data.set("action", torch.tensor(action)))["next"]
        assert reward == after["reward"].item()
        assert (terminated, truncated) == (after["terminated"].item(), after["truncated"].item())
        active.append(info["regime_active"])
        if name == "CrazyflieTrack":
            np.testing.assert_array_equal(info["square_error"], after["square_error"].numpy())
            assert info["time"] == pytest.approx(0.05 * (step + 1))
        data = native.step_mdp(data)
    assert any(active) and (name == "UGVTrack" or truncated)


def test_the_start_can_be_displaced():
    for env, spread in (
        (UGVTrack(start_noise=0.1), 0.1),
        (CrazyflieTrack(Hover(), **SENSORS), 0.1),
    ):
        poses = env.reset(TensorDict(batch_size=[4000]))["pose"]
        expected = torch.full((3,), spread)
        torch.testing.assert_close(poses[:, :3].std(0), expected, rtol=0.1, atol=0)
        assert (poses[:, 3:] == poses[0, 3:]).all()
