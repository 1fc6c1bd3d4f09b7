"""Commands that act late: policies observe the state in which the commands will act."""

import runpy
from collections import deque
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from afm_rl import ActionFlowVectorWrapper, ActionFlowWrapper
from afm_rl.correction import ActionFlow
from afm_rl.dynamics import KnownDynamics
from afm_rl.planning import KnownReward, PlanningEnv
from afm_rl.regimes import Delay
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform, RegimeTransform

STEPS, ROOT = 60, Path(__file__).resolve().parents[2]


def glide(state, action):
    """Two carts on rails: positions and speeds."""
    place, speed = state[..., :2], state[..., 2:]
    speed = 0.98 * speed + 0.1 * action
    return torch.cat([place + 0.1 * speed, speed], -1)


class Carts(gymnasium.Env):
    """Carts whose commands act ``late`` by so many steps each, from step ``at`` on."""

    observation_space = Box(-np.inf, np.inf, (4,), np.float64)
    action_space = Box(-1.0, 1.0, (2,), np.float64)

    def __init__(self, late=(0, 0), at=0, sign=1.0):
        self.late, self.at, self.sign = late, at, sign

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.count = torch.tensor([1.0, -0.5, 0.0, 0.3], dtype=torch.float64), 0
        self.past = deque([np.zeros(2)] * 26, maxlen=26)
        return self.state.numpy().copy(), {}

    def step(self, action):
        self.past.append(np.array(action))
        acts = self.past[-1]
        if self.count >= self.at:
            acts = self.sign * np.array([self.past[-1 - k][a] for a, k in enumerate(self.late)])
        self.count += 1
        self.state = glide(self.state, torch.as_tensor(acts))
        return self.state.numpy().copy(), -float(self.state.square().sum()), False, False, {}


def law(seen):
    """A controller that is fast enough to be upset by a few steps of delay."""
    return np.clip(-3.0 * seen[..., :2] - 3.5 * seen[..., 2:], -1.0, 1.0)


def drive(env, steps=STEPS):
    """Return the states ``(T, S)`` that were measured, and what was told at the end."""
    seen, info = env.reset(seed=0)
    found = []
    for _ in range(steps):
        seen, _, _, _, info = env.step(law(seen))
        found.append(info["afm"]["observation"] if "afm" in info else seen)
    return np.stack(found), info


def test_a_known_delay_shifts_the_loop_and_changes_nothing_else():
    """The first three steps are those of a robot that rests."""
    late, _ = drive(ActionFlowWrapper(Carts((3, 3)), glide, delay=3))
    plain = Carts()
    plain.reset()
    for _ in range(3):
        seen = plain.step(np.zeros(2))[0]
    for measured in late[3:]:
        seen = plain.step(law(seen))[0]
        np.testing.assert_allclose(measured, seen, atol=1e-9)


def test_actuators_with_delays_of_their_own_act_together():
    mixed, _ = drive(ActionFlowWrapper(Carts((3, 1)), glide, delay=[3, 1]))
    same, _ = drive(ActionFlowWrapper(Carts((3, 3)), glide, delay=3))
    np.testing.assert_allclose(mixed, same, atol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["", "reversed"])
def test_a_delay_is_found_and_made_up_for(sign):
    cost = {}
    for compensated in (True, False):
        settings = {"delay_compensation": compensated, "belief": True}
        env = ActionFlowWrapper(Carts((4, 4), at=5, sign=sign), glide, **settings)
        cost[compensated] = np.square(drive(env, 60)[0][40:]).mean()
    assert (drive(env, 25)[1]["afm"]["belief"]["4 steps late"] > 0.9).all()
    assert 10 * cost[True] < cost[False], cost


@pytest.mark.check
@pytest.mark.parametrize(
    "settings",
    [
        pytest.param({"delay": 25}, id="known", marks=pytest.mark.slow),
        pytest.param({"corrector": 25}, id="found"),
    ],
)
def test_delays_of_25_steps_are_made_up_for(settings):
    if "corrector" in settings:
        settings = {"corrector": ActionFlow(-torch.ones(2), torch.ones(2), max_delay=25)}
    env = ActionFlowWrapper(Carts((25, 25)), glide, **settings)
    found, info = drive(env, 200)
    assert info["afm"]["delay"] == 25
    assert np.abs(found[-50:, :2]).max() < 0.1 < np.abs(drive(Carts((25, 25)), 200)[0][-50:]).max()


@pytest.mark.parametrize(
    ("late", "reduced"), [(0, 2), (3, 5), (8, 10), (25, 10)], ids=["", "3", "8", "never"]
)
def test_a_soft_start_lasts_until_an_effect_is_seen(late, reduced):
    """A command of step 0 acts in step ``late`` and is measured in the next one."""
    flow = ActionFlow(-torch.ones(2), torch.ones(2), soft_start=0.25)
    env = ActionFlowWrapper(Carts((late, late)), glide, corrector=flow)
    env.reset(seed=0)
    plan, shares = np.array([0.8, -0.6]), []
    for _ in range(14):
        step = env.step(plan)[-1]["afm"]
        np.testing.assert_array_equal(step["planned_action"], plan)
        shares.append(step["executed_action"] / plan)
    np.testing.assert_allclose(shares[:reduced], 0.25, atol=1e-6)
    if late in (0, 25):  # else the correction has its say
        np.testing.assert_array_equal(shares[reduced:], 1.0)
    assert np.min(shares[reduced]) > 0.5


def test_a_soft_start_spares_a_robot_that_is_late_from_the_first_step():
    largest = []
    for share in (1.0, 0.25):
        flow = ActionFlow(-torch.ones(2), torch.ones(2), soft_start=share)
        states, _ = drive(ActionFlowWrapper(Carts((8, 8)), glide, corrector=flow), 80)
        largest.append(np.abs(states[:, 2:]).max())
    assert largest[1] < 0.9 * largest[0], largest


def test_switched_off_each_axis_is_known_to_act_as_soon_as_it_can():
    env = ActionFlowWrapper(Carts((3, 1)), glide, delay=[3, 1], enabled=False)
    seen, _ = env.reset(seed=0)
    for step in range(60):
        seen, _, _, _, info = env.step(law(seen) + 0.5 * np.sin([step, 0.7 * step]))
        assert not env.memory["corrected"].any() and info["afm"]["innovation"] < 1


WAYS = {  # delays of the robot, settings, steps that are told at the end, what is said of them
    "found": ((8, 8), {}, 8, "8 steps late\nlateness: 8 steps, made up for"),
    "known": ((3, 3), {"delay": 3}, 3, "healthy\nlateness: 3 steps, made up for"),
    "both": ((5, 5), {"delay": 3}, 5, "2 steps late\nlateness: 5 steps, made up for"),
    "left": ((8, 8), {"delay_compensation": False}, 8, "8 steps late\nlateness: 8 steps"),
    "watched": ((2, 2), {"enabled": False}, 0, "2 steps late\nlateness: 2 steps"),
    "none": ((0, 0), {}, 0, "healthy"),
}


@pytest.mark.parametrize("way", WAYS)
def test_the_steps_until_commands_act_are_told_and_said(way):
    """Also while plans are executed as they are, as at the end of these."""
    late, settings, steps, words = WAYS[way]
    env = ActionFlowWrapper(Carts(late), glide, **settings)
    assert env.reset(seed=0)[1]["afm"]["delay"] == settings.get("delay", 0)
    info = drive(env, 110)[1]["afm"]
    assert info["delay"] == steps and isinstance(info["delay"], int)
    assert not info["corrected"] or way in ("found", "left")
    assert env.diagnosis.endswith(words)


@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_a_state_that_is_the_observation_needs_no_observe(precision):
    """As of legged robots: it is given, and found to be what is observed."""

    class Legged(Carts):
        observation_space = Box(-np.inf, np.inf, (4,), precision)

        def step(self, action):
            seen, *rest = super().step(action)
            return seen.astype(precision), *rest

        def reset(self, **given):
            seen, info = super().reset(**given)
            return seen.astype(precision), info

    def state(env, seen):
        return seen.astype(np.float64)

    told, _ = drive(ActionFlowWrapper(Legged((3, 3)), glide, state, delay=3))
    same, _ = drive(ActionFlowWrapper(Legged((3, 3)), glide, state, delay=3, observe=lambda s: s))
    np.testing.assert_array_equal(told, same)


def test_episodes_that_follow_at_once_begin_at_arrival_too():
    """As by a reset: a vector that resets in the same step shows where the first command acts."""

    class Short(Carts):
        def step(self, action):
            seen, reward, *_, info = super().step(action)
            return seen, reward, self.count % 5 == 0, False, info

    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    envs = gymnasium.vector.SyncVectorEnv([lambda: Short((3, 3))], autoreset_mode=mode)
    envs = ActionFlowVectorWrapper(envs, glide, delay=3)
    first, info = envs.reset(seed=0)
    for _ in range(5):
        again, _, over, _, info = envs.step(law(first))
    assert over.all()
    np.testing.assert_array_equal(again, first)
    assert info["afm"]["delay"].tolist() == [3]


def test_nothing_is_predicted_while_nothing_is_late(monkeypatch):
    def refuse(*_):
        raise AssertionError("asked for a prediction")

    monkeypatch.setattr(KnownDynamics, "rollout", refuse)
    for at in (STEPS, 0):
        sign = -1.0 if at == 0 else 1.0  # a fault that is not a delay
        states, _ = drive(ActionFlowWrapper(Carts((0, 0), at, sign), glide))
        plain, _ = drive(Carts())
        assert at == 0 or np.array_equal(states, plain)


def test_policies_in_a_vector_are_shown_the_same():
    how = {"delay": 3, "belief": True}
    alone, one = drive(ActionFlowWrapper(Carts((3, 3)), glide, **how))
    envs = gymnasium.vector.SyncVectorEnv([lambda: Carts((3, 3))] * 2)
    both, two = drive(ActionFlowVectorWrapper(envs, glide, **how))
    for row in range(2):
        np.testing.assert_array_equal(both[:, row], alone)
        for name, chance in one["afm"]["belief"].items():
            np.testing.assert_array_equal(two["afm"]["belief"][name][row], chance)


def test_the_transform_shows_the_same_and_keeps_what_was_measured():
    alone, _ = drive(ActionFlowWrapper(Carts((2, 2)), glide, delay=2), 20)
    model, ends = KnownDynamics(glide, Manifold(4), 2), torch.ones(2, dtype=torch.float64)
    world = PlanningEnv(model, KnownReward(lambda s, a, n: s.sum(-1)), -ends, ends)
    late = RegimeTransform(Delay(), [{"delay": 2.0}])
    env = TransformedEnv(world, Compose(late, ActionFlowTransform(model, delay=2, belief=True)))
    start = torch.tensor([1.0, -0.5, 0.0, 0.3], dtype=torch.float64)
    td = env.reset(TensorDict({"observation": start}))
    for measured in alone:
        td["action"] = torch.from_numpy(law(td["observation"].numpy()))
        td = env.step_mdp(env.step(td))
        np.testing.assert_allclose(td["afm", "observation"], measured, atol=1e-9)
        assert torch.equal(td["observation"], td["afm", "arrival"])
        assert td["afm", "delay"].equal(torch.tensor(2))
        torch.testing.assert_close(td["afm", "belief"].sum(-2), torch.ones_like(ends))
    assert env.transform[1].corrector.causes[:2] == ("no fault", "3 steps late")
    check_env_specs(env)


def test_who_follows_a_clock_looks_ahead():
    """A reference that is taken at arrival is followed as by a healthy robot."""
    example = runpy.run_path(str(ROOT / "examples" / "transform" / "follow_a_clock.py"))
    body, follow = example["Cart"](), example["follow"]
    robot = ActionFlowWrapper(example["Robot"](body), body.move)
    healthy = follow(body, example["Robot"](body, healthy=True), steps=90)
    now, ahead = (follow(body, robot, ahead, steps=90) for ahead in (False, True))
    assert ahead < 1.2 * healthy and now > 5 * healthy


def test_a_policy_without_an_environment_is_told_the_same():
    ends = torch.ones(2, dtype=torch.float64)
    policy = ActionFlowPolicy(
        KnownDynamics(glide, Manifold(4), 2), Bounded(-ends, ends, (2,)), delay=2
    )
    td = policy.make_tensordict_primer()(TensorDict({"observation": torch.zeros(4).double()}))
    assert policy.arrival()(td)["afm", "delay"].equal(torch.tensor(2))
