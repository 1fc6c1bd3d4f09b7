"""The classical estimate of the mass."""

import pytest
import torch
from flight import MassEstimator
from harness import level, refused
from tensordict import TensorDict

from afm_rl.dynamics import Oracle, Quadrotor
from afm_rl.dynamics.quadrotor import quadrotor_step
from afm_rl.learning import GaussianNLLLoss
from afm_rl.regimes import MassFactor, flight_regimes
from afm_rl.spaces.airframe import QuadrotorBody

BODY = QuadrotorBody()


def estimator(regime=None, **settings):
    return MassEstimator(GaussianNLLLoss(Oracle(Quadrotor(), regime or MassFactor())), **settings)


def tick(state, factor, thrust=BODY.hover_thrust):
    """Fly on; all turn a little."""
    action = torch.tensor([thrust, 1e-6, -2e-6, 0.0]).expand(len(state), 4)
    given = action.clone()
    given[:, 0] /= factor
    td = TensorDict({"observation": state, "action": action}, [len(state)])
    return td.set(("next", "observation"), quadrotor_step(state, given, 0.05, 25, BODY))


@pytest.mark.parametrize("regime", [MassFactor(), flight_regimes()], ids=["mass", "all"])
def test_it_converges_to_the_true_factor(regime):
    updater, factor, state = estimator(regime), torch.tensor([0.5, 1.0, 4 / 3]), level(3)
    updater.start(TensorDict({}, [3]))
    off = []
    for _ in range(8):
        td = tick(state, factor)
        loss = updater(td)["loss"]
        state = td["next", "observation"]
        told = updater.model.parameters_now
        off.append((told[:, updater.column] - factor).abs().max())
    assert off[0] > 0.05 and off[-1] < 1e-3
    assert loss.shape == (3,) and updater.refused == 0 and not updater.learns
    others = [k for k in range(told.shape[1]) if k != updater.column]
    assert torch.equal(told[0, others], torch.tensor(regime.identity)[others])


def test_missions_that_end_take_their_estimate_along():
    updater, factor = estimator(share=1.0), torch.tensor([0.5, 2.0])
    updater.start(TensorDict({}, [2]))
    updater(tick(level(2), factor))
    updater.model.select_(torch.tensor([1]))
    updater(tick(level(1), factor[1:]))
    torch.testing.assert_close(
        updater.model.parameters_now, torch.tensor([[2.0]]), rtol=1e-3, atol=0
    )


def test_what_cannot_be_measured_is_left_alone():
    updater, factor = estimator(share=1.0), torch.tensor([0.5, 0.5])
    updater.start(TensorDict({}, [2]))
    updater(tick(level(2), factor, thrust=0.02))  # hardly any thrust
    assert torch.equal(updater.model.parameters_now, torch.ones(2, 1))
    td = tick(level(2), factor)
    td["next", "observation"][0] = torch.nan
    assert updater(td)["loss"].isnan().tolist() == [True, False]
    assert updater.refused == 1
    told = updater.model.parameters_now
    torch.testing.assert_close(told, torch.tensor([[1.0], [0.5]]), rtol=1e-3, atol=0)


@refused(
    ({"share": 0.0}, "updater.share=0.0"),
    ({"share": 1.1}, "updater.share=1.1"),
    ({"least_thrust": 0.0}, "updater.least_thrust=0.0"),
    ({"least": 0.0}, "updater.least=0.0"),
    ({"least": 2.0, "most": 1.0}, "updater.most=1.0"),
)
def test_impossible_settings_are_refused(settings):
    estimator(**settings)
