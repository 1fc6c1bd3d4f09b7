"""The model that knows the regime."""

import torch

from afm_rl.dynamics import Dubins, Oracle


def test_it_predicts_what_the_regime_of_each_mission_does(gains, transitions):
    oracle, (state, action) = Oracle(Dubins(), gains), transitions(4, 7)
    assert torch.equal(oracle(state, action), Dubins()(state, action))  # nothing told yet
    rows = gains.sample((4,), torch.Generator().manual_seed(0))
    oracle.set_regime(rows)
    assert oracle.lead == (4,)
    together = oracle(state, action)
    torch.testing.assert_close(together, Dubins()(state, rows.unsqueeze(1) * action))
    oracle.select_(torch.tensor([2, 0]))
    torch.testing.assert_close(oracle(state[[2, 0]], action[[2, 0]]), together[[2, 0]])


def test_noise_and_units_are_those_of_the_model_behind(gains, transitions, make_ensemble):
    behind = make_ensemble()
    oracle = Oracle(behind, gains)
    told = gains.encode({"v_gain": 2.0})
    oracle.set_regime(told)
    state, action = transitions(5)
    moments = behind.moments(state, action * told)
    torch.testing.assert_close(oracle.moments(state, action), moments)
    noise = behind.noise_scale(state, action * told)
    torch.testing.assert_close(oracle.noise_scale(state, action), noise)
    torch.testing.assert_close(oracle.forecast(state, action)[1], noise)
    torch.testing.assert_close(oracle.standardise(state), behind.standardise(state))


def test_what_it_is_told_does_not_outlive_the_run(gains):
    oracle = Oracle(Dubins(), gains)
    oracle.set_regime(torch.full((2,), 2.0, requires_grad=True))
    assert oracle.state_dict() == {}
    assert not oracle.parameters_now.requires_grad
    assert oracle.select_(torch.tensor([0])) is oracle and oracle.lead == ()
