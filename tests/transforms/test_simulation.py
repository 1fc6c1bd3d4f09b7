"""MuJoCo simulations in TorchRL: their whole state is read, and what is observed at arrival."""

from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.mujoco.reacher_v5 import ReacherEnv
from gymnasium.vector import SyncVectorEnv
from harness import refused
from torchrl.envs import (
    ActionScaling,
    Compose,
    DoubleToFloat,
    GymEnv,
    GymWrapper,
    ObservationNorm,
    ParallelEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from afm_rl import ActionFlowVectorWrapper, ActionFlowWrapper, FaultWrapper, check_model
from afm_rl.correction import LeastSquares
from afm_rl.dynamics import MuJoCoDynamics
from afm_rl.errors import ConfigurationError
from afm_rl.regimes import Delay
from afm_rl.transforms import ActionFlowTransform, RegimeTransform, SimulatorState
from afm_rl.transforms.simulation import Simulation

pytest.importorskip("mujoco")
LATE = 2


def cheetah(**settings):
    return GymEnv("HalfCheetah-v5", **settings)


def skipping():
    return cheetah(frame_skip=2)


def of_dm_control(*task):
    pytest.importorskip("dm_control")
    from torchrl.envs import DMControlEnv

    return DMControlEnv(*task)


cartpole = partial(of_dm_control, "cartpole", "balance")
walker = partial(of_dm_control, "walker", "walk")  # an observation is a number, not a vector


def robot(make, *more):
    """A robot whose commands act late."""
    env = make()
    key = "velocity" if "velocity" in env.observation_spec.keys() else "observation"
    late = RegimeTransform(Delay(), [{"delay": float(LATE)}], observation_key=key)
    return TransformedEnv(env, Compose(late, *more))


def afm(**settings):
    return ActionFlowTransform("mujoco", delay=LATE, **settings)


def beside(make):
    return robot(make, afm())


def inside(make, batch=SerialEnv, **settings):
    return batch(2, lambda: robot(make, afm()), **settings)


def around(make, batch=SerialEnv, **settings):
    workers = batch(2, lambda: robot(make, SimulatorState()), **settings)
    return TransformedEnv(workers, afm())


def of(make):
    return MuJoCoDynamics(make()._env)


def normaliser():
    return ObservationNorm(0.0, 2.0, ["observation"])


def check_shown(env, keys):
    """What policies are shown is what is measured when their action acts."""
    data = env.rollout(12, break_when_any_done=False)
    assert (data["afm", "delay"] == LATE).all() and data["afm", "delay"].dtype is torch.int64
    assert not data["next", "afm", "corrected"].any()
    measured = data["afm", "observation"]
    measured = measured if len(keys) > 1 else {keys[0]: measured}
    for key in keys:
        assert data[key].dtype is measured[key].dtype
        shown, later = data[key][..., :-LATE, :], measured[key][..., LATE:, :]
        torch.testing.assert_close(shown, later, atol=1e-5, rtol=1e-4)
        assert not torch.equal(data[key], measured[key])


@pytest.mark.check
@pytest.mark.parametrize(
    ("place", "make"), [(beside, cheetah), (inside, skipping), (around, cartpole), (inside, walker)]
)
def test_policies_are_shown_what_is_observed_at_arrival(place, make):
    env = place(make)
    check_env_specs(env)
    check_shown(env, list(make().observation_spec.keys()))


@pytest.mark.parametrize("place", [inside, around])
def test_in_processes_of_their_own(place):
    env = place(cartpole, ParallelEnv, mp_start_method="fork")
    try:
        check_shown(env, ["position", "velocity"])
    finally:
        env.close(raise_if_closed=False)


@pytest.mark.parametrize("first", [True, False])
def test_casts_may_stand_on_either_side(first):
    chain = [afm(), DoubleToFloat(), StepCounter()]
    env = robot(cartpole, *chain if first else chain[1::-1])
    check_env_specs(env)
    check_shown(env, ["position", "velocity"])


def test_it_is_the_wrapper_of_gymnasium():
    """Also while the delay has yet to be found."""
    one, two = (
        FaultWrapper(gymnasium.make("HalfCheetah-v5", reset_noise_scale=0.0), {"delay": LATE})
        for _ in range(2)
    )
    wrapper = ActionFlowWrapper(one, "mujoco")
    env = TransformedEnv(GymWrapper(two), ActionFlowTransform("mujoco"))
    td = env.reset()
    wrapper.reset()
    draw = np.random.default_rng(0)
    for _ in range(15):
        action = draw.uniform(-1, 1, 6).astype(np.float32)
        td = env.step_mdp(env.step(td.set("action", torch.from_numpy(action))))
        seen, _, _, _, info = wrapper.step(action)
        np.testing.assert_allclose(td["observation"], seen, atol=1e-3)
        np.testing.assert_allclose(td["afm", "observation"], info["afm"]["observation"], atol=1e-3)
        assert td["afm", "delay"] == info["afm"]["delay"]
    assert td["afm", "delay"] == LATE


def test_a_model_of_ones_own_reads_the_whole_state_too():
    chain = Compose(SimulatorState(), ActionFlowTransform(of(cheetah), in_keys=["simulator_state"]))
    data = TransformedEnv(cheetah(), chain).rollout(5)
    assert data["simulator_state"].shape == data["afm", "arrival"].shape == (5, 18)
    assert data["next", "afm", "innovation"].max() < 1e-6


def put(env, *before, model="mujoco", **settings):
    transform = ActionFlowTransform(model, **settings)
    TransformedEnv(env(), Compose(*before, transform)).reset()


@refused(
    (lambda: put(lambda: SerialEnv(2, cheetah)), r"elsewhere; append SimulatorState\(\)"),
    (lambda: put(cheetah, model=of(cheetah)), r"\(17,\), .* has 18 numbers; .*model='mujoco'"),
    (lambda: put(cartpole, model=of(cartpole)), r"\['position', 'velocity'\]; .*model='mujoco'"),
    (lambda: put(lambda: GymEnv("Pendulum-v1")), "Pendulum-v1.* has no MuJoCo model"),
    (lambda: put(cheetah, ActionScaling(loc=0.0, scale=2.0)), "before those that change actions"),
    (lambda: put(cheetah, normaliser(), delay=2), "delay=2: .*before those that change obs"),
    (lambda: put(cheetah, corrector=LeastSquares([-1.0], [1.0])), "for 1 actions, .* has 6"),
    (lambda: ActionFlowTransform("mujoco").model, "put the transform around an environment first"),
    (lambda: ActionFlowTransform("dart"), "transform.model='dart': .*mujoco"),
)
def test_what_cannot_be_read_is_refused_with_the_way(use):
    use()


def test_observations_that_change_on_the_way_are_shown_as_measured():
    """A warning reports this when the delay is estimated."""
    chain = Compose(normaliser(), ActionFlowTransform("mujoco"))
    env = TransformedEnv(robot(cheetah), chain)
    with pytest.warns(UserWarning, match="before those that change observations"):
        data = env.rollout(15)
    assert data["next", "afm", "delay"][-1] == LATE
    assert data["next", "afm", "arrival"].shape == (15, 18)


def stopped_early():
    """A robot whose solver of contacts takes a single iteration."""
    env = gymnasium.make("HalfCheetah-v5")
    env.unwrapped.model.opt.iterations = 1
    return env


def innovations_of(shell, steps=60):
    env = shell(stopped_early())
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(steps):
        yield np.max(env.step(env.action_space.sample())[-1]["afm"]["innovation"])


def innovations_in_torchrl(_, steps=60):
    env = TransformedEnv(GymWrapper(stopped_early()), ActionFlowTransform("mujoco"))
    env.set_seed(0)
    return env.rollout(steps, break_when_any_done=False)["next", "afm", "innovation"].tolist()


def of_one(env):
    return ActionFlowWrapper(env)


def of_a_vector(env):
    return ActionFlowVectorWrapper(SyncVectorEnv([lambda: env]))


class Reacher(ReacherEnv):
    """A task with a constructor of its own, which must be called once."""

    made = 0

    def __init__(self):
        super().__init__()
        type(self).made += 1


class Containing(gymnasium.Env):
    """The simulation is in an environment inside, as in the mazes of gymnasium-robotics."""

    def __init__(self):
        self.reacher = ReacherEnv()
        self.action_space = self.reacher.action_space
        self.observation_space = self.reacher.observation_space

    def _get_obs(self):
        return self.reacher._get_obs()

    def reset(self, *, seed=None, options=None):
        return self.reacher.reset(seed=seed)

    def step(self, action):
        return self.reacher.step(action)


class Telling(Containing):
    """It says what is in its simulation, but nothing can be put there."""

    model = property(lambda self: self.reacher.model)
    data = property(lambda self: self.reacher.data)


class Unobserved(Telling):
    """Its observations need more than its simulation."""

    def _get_obs(self, more):
        return super()._get_obs()


@pytest.mark.parametrize("make", [Reacher, Containing, Telling])
def test_environments_with_a_simulation_within_are_read_and_left_as_they_were(make):
    assert check_model(make(), steps=60).right  # with the frames that are skipped
    plain, observed = make(), make()
    Reacher.made = 0
    wrapper = ActionFlowWrapper(observed)
    for env in (plain, wrapper):
        env.reset(seed=0)
    simulation, other = Simulation(observed), np.linspace(-1, 1, 8)
    assert simulation.seen == ["observation"]
    draw = np.random.default_rng(0)
    for _ in range(20):
        action = draw.uniform(-1, 1, 2).astype(np.float32)
        expected, given = plain.step(action), wrapper.step(action)
        np.testing.assert_array_equal(expected[0], given[0])
        now = simulation.state.numpy()
        shown = simulation.observe(np.stack([other, now]))["observation"]
        np.testing.assert_allclose(shown[1], given[0], atol=1e-5)
        assert abs(shown[0] - shown[1]).max() > 0.1
        np.testing.assert_array_equal(simulation.state, now)
    assert Reacher.made == 0


def test_an_environment_that_does_not_observe_its_simulation_alone_has_no_such_function():
    env = FaultWrapper(Unobserved(), {"delay": 2})
    assert check_model(Unobserved(), steps=60).right and Simulation(env).seen == []
    with pytest.raises(ConfigurationError, match="give observe="):
        ActionFlowWrapper(env, delay=2).reset(seed=0)


@pytest.mark.parametrize("batch", ["gymnasium", "torchrl"])
def test_of_environments_in_this_process_none_is_made_to_look_at_it(batch):
    Reacher.made = 0
    if batch == "gymnasium":
        envs = ActionFlowVectorWrapper(SyncVectorEnv([Reacher] * 2))
        envs.reset(seed=0)
        envs.step(envs.action_space.sample())
        assert Reacher.made == 2
        return
    workers = SerialEnv(2, lambda: TransformedEnv(GymWrapper(Reacher()), SimulatorState()))
    workers.reset()
    made = Reacher.made
    TransformedEnv(workers, ActionFlowTransform("mujoco")).rollout(3)
    assert Reacher.made == made


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize(
    ("play", "shell"),
    [(innovations_of, of_one), (innovations_of, of_a_vector), (innovations_in_torchrl, None)],
)
def test_a_solver_that_is_stopped_early_goes_on_where_the_robots_did(
    play, shell, told, monkeypatch
):
    if not told:
        monkeypatch.setattr(MuJoCoDynamics, "warm_start", lambda *_: None)
    assert (max(play(shell)) < 1e-6) == told
