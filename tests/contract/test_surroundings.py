"""Whatever surrounds it: with a model that is right, the transform stays silent."""

import pytest
import torch
from pushing import Car
from torchrl import envs
from torchrl.envs import ActionScaling, FrameSkipTransform, GymWrapper, StepCounter

from afm_rl.dynamics import Dubins, KnownDynamics, dubins_step
from afm_rl.envs import UGVTrack
from afm_rl.errors import ConfigurationError
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform

LOC, SCALE = torch.tensor([1.0, -2.0, 0.5]), torch.tensor([2.0, 0.5, 3.0])
DT = 0.2


def track(**settings):
    return UGVTrack(batch_size=(3,), process_noise=0.0, missions={"regime": {}}, **settings)


HALF = track().action_spec_unbatched.space.high


def afm(step=None):
    """Correct over the model of the robot, or over your own step."""
    model = Dubins() if step is None else KnownDynamics(step, Manifold(3), 2)
    return ActionFlowTransform(model)


def silent(*chain, env=None, steps=6):
    """Roll out; check that nothing was found amiss, and return the data."""
    env = envs.TransformedEnv(env or track(), envs.Compose(*chain))
    data = env.rollout(steps, break_when_any_done=False)
    memory = data["next", "afm"]
    assert float(memory["innovation"].max()) < 0.1 and not memory["corrected"].any()
    assert torch.equal(memory["executed_action"], memory["planned_action"])
    return data


def normaliser(out="observation"):
    keys = {"in_keys": ["observation"], "out_keys": [out]}
    return envs.ObservationNorm(LOC, SCALE, **keys, standard_normal=True)


@pytest.mark.parametrize("first", [True, False])
def test_transforms_of_rewards_and_of_other_entries_on_either_side(first):
    rewards = envs.RewardScaling(3.0, 0.1), envs.RewardClipping(-1.0, 1.0), envs.RewardSum()
    others = [normaliser("seen"), *rewards, StepCounter(4)]
    silent(*[*others, afm()] if first else [afm(), *others])


def test_a_normaliser_on_either_side():
    def step(state, action):
        return (dubins_step(state * SCALE + LOC, action, DT) - LOC) / SCALE

    silent(afm(), normaliser())
    data = silent(normaliser(), afm(step), steps=4)
    torch.testing.assert_close(data["next", "afm", "observation"], data["next", "observation"])


def test_action_scaling_on_either_side():
    data = silent(afm(), ActionScaling())
    planned = data["next", "afm", "planned_action"]  # in the units of the robot
    torch.testing.assert_close(planned, data["action"] * HALF)
    data = silent(ActionScaling(), afm(lambda state, action: dubins_step(state, action * HALF, DT)))
    assert torch.equal(data["next", "afm", "executed_action"], data["action"])


def test_a_robot_in_double_precision_behind_single_precision():
    keys = {"in_keys": ["observation"], "in_keys_inv": ["action"]}
    silent(envs.DoubleToFloat(**keys), afm(), env=track(dtype=torch.float64))
    data = silent(afm().double(), envs.DoubleToFloat(**keys), env=track(dtype=torch.float64))
    assert data["action"].dtype is torch.float32
    assert data["next", "afm", "executed_action"].dtype is torch.float64


def test_a_frame_skip_before_it_with_a_model_of_the_whole_stride_and_none_after_it():
    def stride(state, action):
        return dubins_step(dubins_step(state, action, DT), action, DT)

    silent(FrameSkipTransform(2), afm(stride), env=GymWrapper(Car()))
    with pytest.raises(ConfigurationError, match="put FrameSkipTransform before it"):
        silent(StepCounter(), afm(), FrameSkipTransform(2), env=GymWrapper(Car()))
    with pytest.raises(ConfigurationError, match="put FrameSkipTransform before it"):
        envs.TransformedEnv(GymWrapper(Car()), afm()).append_transform(
            FrameSkipTransform(2)
        ).reset()
