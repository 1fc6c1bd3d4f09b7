"""A residual is fitted to a recording of the healthy robot, or refused in a sentence."""

import pytest
import torch
from puck import Puck, push
from tensordict import TensorDict

from afm_rl import ActionFlowWrapper, fit_residual
from afm_rl.dynamics import KnownDynamics, LinearResidual
from afm_rl.errors import ConfigurationError
from afm_rl.spaces.manifold import Manifold

MODEL = KnownDynamics(push, Manifold(4), 2)


def steps(count=100, gain=1.1, noise=1e-4, seed=0):
    generator = torch.Generator().manual_seed(seed)
    state, action = (torch.randn(count, n, generator=generator) for n in (4, 2))
    after = push(state, gain * action)
    return state, action, after + noise * torch.randn(count, 4, generator=generator)


def test_transitions_a_tensordict_and_a_step_function_give_the_same():
    state, action, after = steps()
    td = TensorDict({"observation": state, "action": action}, [100])
    td["next", "observation"] = after
    fits = [
        fit_residual(MODEL, td),
        fit_residual(push, td),
        fit_residual(MODEL, (state, action, after)),
    ]
    assert all(torch.equal(one.weights, fits[0].weights) for one in fits)
    missed = [(model(state, action) - after).abs().mean() for model in (fits[0], MODEL)]
    assert missed[0] < 0.1 * missed[1]


def test_a_recording_of_a_wrapper(tmp_path):
    file = tmp_path / "healthy.csv"
    env = ActionFlowWrapper(Puck(ends=40, gain=0.9), push, record=file, enabled=False)
    env.action_space.seed(0)
    for k in range(120):
        if k % 40 == 0:
            env.reset(seed=k)
        env.step(env.action_space.sample())
    model = fit_residual(MODEL, file)
    assert int(model.steps) == 117  # the last step of an episode is not recorded
    state, action = torch.randn(9, 4), torch.rand(9, 2)
    missed = [(m(state, action) - push(state, 0.9 * action)).abs().mean() for m in (model, MODEL)]
    assert missed[0] < 0.1 * missed[1]


def test_a_known_delay_is_taken_into_account():
    state, action = [torch.zeros(4)], torch.randn(100, 2)
    for k in range(100):
        state.append(push(state[-1], 1.1 * action[max(k - 2, 0)]))
    state = torch.stack(state)
    model = fit_residual(MODEL, (state[:-1], action, state[1:]), delay=2)
    assert int(model.steps) == 98 and bool((model.explained > 0.9).any())
    with pytest.raises(ConfigurationError, match="2 steps late"):
        fit_residual(MODEL, (state[:-1], action, state[1:]))


REFUSED = {
    "30 of 30 steps are finite: expected at least 50": lambda: [x[:30] for x in steps()],
    "40 of 100 steps are finite": lambda: [
        x.where(torch.arange(100)[:, None] < 40, torch.nan) for x in steps()
    ],
    "give the model of this robot": lambda: [x[:, :-1] for x in steps()],
    "look like a fault: all reversed; record the healthy robot": lambda: steps(gain=-1.0),
    "use it as it is": lambda: steps(gain=1.0, noise=1e-5),
    "recording of 2 parts": lambda: steps()[:2],
    "no such file": lambda: "nowhere.csv",
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_cannot_be_fitted_is_refused(words):
    with pytest.raises(ConfigurationError, match=words):
        fit_residual(MODEL, REFUSED[words]())


def test_noise_above_the_stated_one_is_measured_and_that_is_said():
    with pytest.warns(UserWarning, match="only the noise is measured"):
        model = fit_residual(MODEL, steps(gain=1.0, noise=0.1))
    assert not bool(model.weights.any()) and bool((model.noise > 0.05).all())


def test_the_guard_can_be_switched_off():
    assert isinstance(fit_residual(MODEL, steps(gain=-1.0), guard=False), LinearResidual)
