"""The windows on which a flow is refined for one robot."""

import pytest
import torch

from afm_rl.correction import ActionFlow, PaperFlow
from afm_rl.correction.network import AxisNetwork
from afm_rl.correction.training.counterfactuals import Windows, draw_counterfactuals, imagine
from afm_rl.dynamics import Dubins, Quadrotor
from afm_rl.regimes import ActionGain, MassFactor


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


def test_windows_show_the_regime_its_inverse_and_its_effects(small_flow, states, generator):
    twice = ActionGain(["v_gain", "omega_gain"], low=2.0, high=2.0, nominal=0.0)
    flow, size = small_flow(), (500, 12, 3)
    made = draw_counterfactuals(flow, Dubins(), twice, states, size, "clip", generator)
    executed, effective, std, valid = made.rows
    assert executed.abs().max() <= 1 and valid[:, -1].all() and (std >= 0).all()
    assert (valid.diff(dim=1) >= 0).all()  # what is missing is the oldest
    moving = executed[:, -1].abs() > 0.1
    gain = torch.where(moving, effective[:, -1] / executed[:, -1], 2.0)
    torch.testing.assert_close(gain.abs(), torch.full_like(gain, 2.0), rtol=0, atol=0.3)
    known, sign = moving.all(-1), 2.0 * gain.sign().unsqueeze(1)
    inverse, effect = (made.planned / sign).clamp(-1, 1), made.probe * sign
    torch.testing.assert_close(made.intended[known], inverse[known])
    torch.testing.assert_close(made.effect[known], effect[known])
    inside = (made.planned.abs() <= 1).all(-1).float().mean()
    assert 0.5 < float(inside) < 0.7  # the others ask for what can be had


def test_beyond_the_box_effects_go_on_straight(box, generator, make_ensemble):
    low, high = box
    state, effect = torch.zeros(50, 3), 2.5 * high.expand(50, 2)
    seen = imagine(Dubins(), state, effect, low, high, generator)
    expected = torch.tensor([0.5, 0.0, 0.75]).expand(50, 3)
    torch.testing.assert_close(seen, expected, rtol=0, atol=5e-3)
    spread = (seen - expected).std(0)
    torch.testing.assert_close(spread, torch.full((3,), 1e-3), rtol=0.5, atol=0)
    model = make_ensemble()
    model.noise_scale = lambda state, action: torch.zeros_like(state)
    model.forecast = lambda state, action: (model(state, action), torch.zeros_like(state))
    once, twice = (
        imagine(model, state, k * high.expand(50, 2), low, high, generator) for k in (2, 3)
    )
    edge = model(state, high.expand(50, 2))
    torch.testing.assert_close(twice - edge, 2 * (once - edge), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("kind", ["physics", "base class", "ensemble"])
def test_in_the_box_no_derivative_is_needed(kind, make_ensemble, generator, monkeypatch):
    model = {"physics": Dubins, "base class": Quadrotor, "ensemble": make_ensemble}[kind]()
    size = model.action_size
    state, effect = model.manifold.project(torch.rand(5, model.state_size)), torch.zeros(5, size)
    asked = []
    whole = type(model).jacobian
    monkeypatch.setattr(
        type(model), "jacobian", lambda m, s, a: asked.append(len(s)) or whole(m, s, a)
    )
    with torch.no_grad():
        expected, noise = model.forecast(state, effect)
        seen = imagine(model, state, effect, -torch.ones(size), torch.ones(size), generator)
    assert sum(asked) == 0
    assert (model.manifold.difference(seen, expected).abs() < 5 * noise).all()


def test_training_states_lie_on_the_manifold(monkeypatch, generator):
    seen = []
    forecast = Quadrotor.forecast

    def spy(model, state, action):
        seen.append(state)
        return forecast(model, state, action)

    monkeypatch.setattr(Quadrotor, "forecast", spy)
    low, high = torch.tensor([0.0, -1.0, -1.0, -1.0]), torch.ones(4)
    states = torch.zeros(13), torch.ones(13)
    flow = ActionFlow(low, high, network=AxisNetwork(width=16, latent=8))
    Windows(flow).draw(Quadrotor(), MassFactor(), states, 8, generator)
    assert seen
    for state in seen:
        torch.testing.assert_close(state[..., 6:10].norm(dim=-1), torch.ones(state.shape[:-1]))
    paper = PaperFlow(low, high, [3, 4], 13)
    monkeypatch.setattr(
        Quadrotor, "forward", lambda model, state, action: seen.append(state) or state
    )
    monkeypatch.setattr("afm_rl.spaces.manifold.Manifold.difference", lambda m, a, b: a - b)
    paper._examples(Quadrotor(), states, 8, generator)
    torch.testing.assert_close(seen[-1][..., 6:10].norm(dim=-1), torch.ones(8))
