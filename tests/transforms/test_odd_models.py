"""A model or a plan that cannot be right is named at once, at the caller's line."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from puck import Puck, push
from shells import pucks, starts
from tensordict import TensorDict
from torchrl.data import Bounded

from afm_rl import ActionFlowVectorWrapper, ActionFlowWrapper, check_model
from afm_rl.dynamics import KnownDynamics
from afm_rl.errors import ConfigurationError
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform, CorrectionLoop

BOX = Bounded(-1.0, 1.0, (2,))


def in_place(state, action):
    state[..., 2:] += 0.1 * action
    return state


def action_in_place(state, action):
    return push(state, action.mul_(2.0))


ODD = {
    "changes its argument state in place": in_place,
    "changes its argument action in place": action_in_place,
    "predicts no finite numbers": lambda state, action: push(state, action).log(),
    "predicts no motion": lambda state, action: state + 0 * action.sum(),
}


def vector(model):
    makers = [Puck] * 2
    ActionFlowVectorWrapper(gymnasium.vector.SyncVectorEnv(makers), model).reset(seed=0)


def transform(model):
    env = pucks(1.0, ActionFlowTransform(model))
    env.reset(TensorDict({"observation": next(starts(torch.float32))}))


SHELLS = {
    "wrapper": lambda model: ActionFlowWrapper(Puck(), model).reset(seed=0),
    "vector": vector,
    "transform": transform,
    "check_model": lambda model: check_model(Puck(), model),
}


@pytest.mark.parametrize("shell", SHELLS)
@pytest.mark.parametrize("said", ODD)
def test_a_model_that_cannot_be_right_is_named_at_once(said, shell):
    if "no motion" in said:
        with pytest.warns(UserWarning, match=said) as found:
            SHELLS[shell](ODD[said])
        assert [w.filename for w in found if said in str(w.message)] == [__file__]
    else:
        with pytest.raises(ConfigurationError, match=said):
            SHELLS[shell](ODD[said])


def test_a_model_is_looked_at_in_the_first_state_that_is_a_number():
    loop = CorrectionLoop("robot").complete(KnownDynamics(in_place, Manifold(4), 2), BOX)
    loop.begin(torch.full((4,), torch.nan), BOX)
    with pytest.raises(ConfigurationError, match=r"robot\.model changes its argument state"):
        loop.begin(torch.zeros(4), BOX)


def test_a_plan_of_nan_is_said_once_at_the_line_of_the_caller():
    env = ActionFlowWrapper(Puck(), push)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        env.reset(seed=0)
        for _ in range(5):
            *_, info = env.step(np.full(2, np.nan, dtype=np.float32))
            assert np.isfinite(info["afm"]["executed_action"]).all()
    (warning,) = said
    assert "'action' is not finite" in str(warning.message) and warning.filename == __file__
