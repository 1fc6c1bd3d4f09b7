"""Whatever surrounds it: with a model that is right, the transform stays silent."""

import pytest
import torch
from pushing import Car
from torchrl.envs import (
    ActionScaling,
    Compose,
    DoubleToFloat,
    FrameSkipTransform,
    GymWrapper,
    ObservationNorm,
    RewardClipping,
    RewardScaling,
    RewardSum,
    StepCounter,
    TransformedEnv,
)

from afm_rl.correction import ActionFlow
from afm_rl.dynamics import Dubins, KnownDynamics, dubins_step
from afm_rl.envs import UGVTrack
from afm_rl.errors import ConfigurationError
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform

LOC, SCALE = torch.tensor([1.0, -2.0, 0.5]), torch.tensor([2.0, 0.5, 3.0])
DT = 0.2


def track(**settings):
    return UGVTrack(batch_size=(3,), process_noise=0.0, missions={"regime": {}}, **settings)


def box_of(env):
    space = env.action_spec_unbatched.space
    return space.low, space.high


def afm(box, model=None, **settings):
    model = Dubins() if model is None else model
    flow = ActionFlow(*box)
    return ActionFlowTransform(model, flow, **settings)


def silent(env, steps=6):
    """Roll out; check that nothing was found amiss, and return the data."""
    data = env.rollout(steps, break_when_any_done=False)
    memory = data["next", "afm"]
    assert float(memory["innovation"].max()) < 0.1 and not memory["corrected"].any()
    assert torch.equal(memory["executed_action"], memory["planned_action"])
    return data


def normaliser(out="observation"):
    keys = {"in_keys": ["observation"], "out_keys": [out]}
    return ObservationNorm(LOC, SCALE, **keys, standard_normal=True)


def in_normalised_space(state, action):
    moved = dubins_step(state * SCALE + LOC, action, DT)
    return (moved - LOC) / SCALE


EITHER_SIDE = {
    "normaliser under another key": lambda: [normaliser("seen")],
    "reward": lambda: [RewardScaling(3.0, 0.1), RewardClipping(-1.0, 1.0), RewardSum()],
    "counter": lambda: [StepCounter(4)],
}


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("others", EITHER_SIDE.values(), ids=EITHER_SIDE)
def test_transforms_on_either_side(others, first):
    env = track()
    chain = [*others(), afm(box_of(env))] if first else [afm(box_of(env)), *others()]
    silent(TransformedEnv(env, Compose(*chain)))


def test_a_normaliser_after_it():
    env = track()
    silent(TransformedEnv(env, Compose(afm(box_of(env)), normaliser())))


def test_a_normaliser_before_it_with_a_model_of_the_normalised_state():
    env, box = track(), box_of(track())
    model = KnownDynamics(in_normalised_space, Manifold(3), 2)
    data = silent(TransformedEnv(env, Compose(normaliser(), afm(box, model))), steps=4)
    torch.testing.assert_close(data["next", "afm", "observation"], data["next", "observation"])


def test_action_scaling_after_it():
    env = track()
    data = silent(TransformedEnv(env, Compose(afm(box_of(env)), ActionScaling())))
    planned = data["next", "afm", "planned_action"]  # in the units of the robot
    torch.testing.assert_close(planned, data["action"] * box_of(env)[1])


def test_action_scaling_before_it_with_a_model_of_the_scaled_action():
    env = track()
    half = box_of(env)[1]
    model = KnownDynamics(lambda s, a: dubins_step(s, a * half, DT), Manifold(3, [2]), 2)
    unit = -torch.ones(2), torch.ones(2)
    data = silent(TransformedEnv(env, Compose(ActionScaling(), afm(unit, model))))
    assert torch.equal(data["next", "afm", "executed_action"], data["action"])


@pytest.mark.parametrize("first", [True, False])
def test_a_robot_in_double_precision_behind_single_precision(first):
    env = track(dtype=torch.float64)
    box = [bound.float() for bound in box_of(env)]
    cast = DoubleToFloat(in_keys=["observation"], in_keys_inv=["action"])
    if first:
        silent(TransformedEnv(env, Compose(cast, afm(box))))
    else:
        whole = TransformedEnv(env, Compose(afm(box_of(env)).double(), cast))
        data = silent(whole)
        assert data["action"].dtype is torch.float32
        assert data["next", "afm", "executed_action"].dtype is torch.float64


def skipping(*chain):
    return TransformedEnv(GymWrapper(Car()), Compose(*chain))


def stride(state, action):
    return dubins_step(dubins_step(state, action, DT), action, DT)


UNIT = -torch.ones(2), torch.ones(2)


def test_a_frame_skip_before_it_with_a_model_of_the_whole_stride():
    model = KnownDynamics(stride, Manifold(3, [2]), 2)
    silent(skipping(FrameSkipTransform(2), afm(UNIT, model)))


def test_a_frame_skip_after_it_is_refused():
    with pytest.raises(ConfigurationError, match="put FrameSkipTransform before it"):
        skipping(StepCounter(), afm(UNIT), FrameSkipTransform(2)).reset()
    with pytest.raises(ConfigurationError, match="put FrameSkipTransform before it"):
        skipping(afm(UNIT)).append_transform(FrameSkipTransform(2)).reset()
