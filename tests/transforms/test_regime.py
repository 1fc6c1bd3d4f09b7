"""The regime transform: any regime on any environment."""

import pytest
import torch
from torchrl.envs import (
    Compose,
    GymEnv,
    ObservationNorm,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs, step_mdp

from afm_rl.correction import L1Augmentation
from afm_rl.dynamics import KnownDynamics
from afm_rl.planning import KnownReward, PlanningEnv
from afm_rl.regimes import ActionGain, Delay, Regime
from afm_rl.regimes import Compose as Regimes
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform, RegimeTransform

GAIN = ActionGain(["torque"])
LATE = Regimes({"delay": Delay(), "gain": GAIN})


def pendulum(steps=200):
    return GymEnv("Pendulum-v1", max_episode_steps=steps)


def reversal(at=3, **settings):
    return RegimeTransform(GAIN, [{}, {"torque": -1.0}], at=[at], **settings)


def rows(*gains):
    """Return phases ``(B, 2, 1)``: nominal, then one gain for each environment."""
    return torch.stack([torch.tensor([[1.0], [gain]]) for gain in gains])


def ratio(data, prefix="regime"):
    effect = data["next"][prefix]["effective_action"] / data["action"]
    return effect.squeeze(-1).round(decimals=4).tolist()


def push(state, action):
    return state + 0.1 * action


def line(dtype=torch.float32):
    """Return a stateless environment of any batch shape: a point on a line."""
    model = KnownDynamics(push, Manifold(1), action_size=1)
    low, high = torch.tensor([-1.0], dtype=dtype), torch.tensor([1.0], dtype=dtype)
    return PlanningEnv(model, KnownReward(lambda s, a, after: -after[..., 0].abs()), low, high)


def test_each_environment_has_its_own_regime():
    chain = RegimeTransform(GAIN, rows(0.5, -1.0, 1.0), at=[2])
    data = TransformedEnv(SerialEnv(3, pendulum), chain).rollout(3)
    assert ratio(data) == [[1.0, 1.0, 0.5], [1.0, 1.0, -1.0], [1.0, 1.0, 1.0]]


@pytest.mark.parametrize(("clip", "largest"), [(True, 1.0), (False, 1.5)])
def test_actuators_saturate_unless_told_otherwise(clip, largest):
    env = TransformedEnv(line(), RegimeTransform(GAIN, [{"torque": 2.0}], clip=clip))
    for command, effect in ((0.25, 0.5), (0.75, largest)):
        data = env.step(env.reset().set("action", torch.tensor([command])))
        assert data["action"].item() == command  # it stays what it was
        assert data["next", "regime", "effective_action"].item() == effect
        assert data["next", "observation"].item() == pytest.approx(0.1 * effect)


def test_late_commands_arrive_late_and_none_outlives_a_reset():
    chain = RegimeTransform(LATE, [{"delay": 1}])
    env = TransformedEnv(SerialEnv(2, pendulum), Compose(chain, StepCounter(3)))
    data = env.rollout(5, break_when_any_done=False)
    effect, command = data["next", "regime", "effective_action"], data["action"]
    torch.testing.assert_close(effect[:, 1:3], command[:, :2])
    torch.testing.assert_close(effect[:, 4], command[:, 3])
    assert (effect[:, [0, 3]] == 0).all()


def test_a_reset_of_some_leaves_the_others_alone():
    env = TransformedEnv(SerialEnv(3, pendulum), reversal(2))
    td = env.reset()
    for _ in range(3):
        td = step_mdp(env.rand_step(td))
    before = td["regime"].clone()
    reset = torch.tensor([[False], [True], [False]])
    after = env.reset(td.clone().set("_reset", reset))["regime"]
    assert after["step"].tolist() == [3, 0, 3]
    assert after["parameters"].flatten().tolist() == [-1.0, 1.0, -1.0]
    torch.testing.assert_close(after["state"][[0, 2]], before["state"][[0, 2]])
    assert not torch.equal(after["state"][1], before["state"][1])


def test_episodes_that_end_start_the_schedule_anew():
    env = TransformedEnv(pendulum(steps=3), reversal(2))
    data = env.rollout(6, break_when_any_done=False)
    assert ratio(data) == [1.0, 1.0, -1.0] * 2


def test_a_branch_goes_on_from_its_own_memory():
    env = TransformedEnv(line(), reversal(1))
    start = env.reset()
    first = env.step(start.clone().set("action", torch.tensor([0.5])))
    env.rollout(5)  # must not matter
    second = env.step(step_mdp(first).set("action", torch.tensor([0.5])))
    assert second["next", "regime", "effective_action"].item() == -0.5
    again = env.step(start.clone().set("action", torch.tensor([0.5])))
    assert again["next", "regime", "effective_action"].item() == 0.5


def test_the_corrected_action_is_what_is_affected():
    model = KnownDynamics(push, Manifold(1), action_size=1)
    flow = L1Augmentation(torch.tensor([-1.0]), torch.tensor([1.0]), dt=0.1)
    chain = Compose(reversal(2), ActionFlowTransform(model, flow), StepCounter())
    env = TransformedEnv(line(), chain)
    check_env_specs(env)
    td, signs = env.reset(), [1.0, 1.0, -1.0, -1.0]
    for sign in signs:
        td = env.step(td.set("action", torch.tensor([0.5])))
        executed = td["next", "afm", "executed_action"]
        torch.testing.assert_close(td["next", "regime", "effective_action"], sign * executed)
        td = step_mdp(td)
    assert not torch.equal(executed, torch.tensor([0.5]))  # it has been corrected


class Above(Regime):
    """The motor works only where the cosine is above a limit."""

    names, identity = ("limit",), (-2.0,)

    def apply(self, action, parameters, state, past=None, noise=None):
        return torch.where(state[..., :1] > parameters, action, 0.0)

    def sample(self, shape, generator=None):
        return torch.zeros(*shape, 1)


def test_a_later_normaliser_does_not_disturb_the_state_it_acts_in():
    effects = []
    for out_key in ("elsewhere", "observation"):
        norm = ObservationNorm(9.0, 3.0, in_keys=["observation"], out_keys=[out_key])
        chain = Compose(RegimeTransform(Above(), [{"limit": -0.7}]), norm)
        env = TransformedEnv(pendulum(), chain)
        env.set_seed(1)
        data = env.rollout(40, lambda td: td.set("action", torch.tensor([1.0])))
        effects.append(data["next", "regime", "effective_action"].flatten().tolist())
    assert effects[0] == effects[1] and set(effects[0]) == {0.0, 1.0}
