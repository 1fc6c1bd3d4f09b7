"""The classical baselines on the universal pairs."""

import pytest
import torch

from afm_rl.correction import LeastSquares
from afm_rl.correction.achievable import MODES
from afm_rl.correction.classical import weigh
from afm_rl.correction.least_squares import fit_affine, fit_gain

LOW, HIGH = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])
TURN = torch.tensor([[0.6, -0.8], [0.8, 0.6]])
REGIMES = {
    "gain": lambda sent: torch.tensor([-0.8, 0.9]) * sent[-1],
    "gain_offset": lambda sent: torch.tensor([-0.8, 0.9]) * sent[-1] + 0.2,
    "affine": lambda sent: sent[-1] @ TURN.mT + 0.1,
}


def actions(*shape):
    return 2 * torch.rand(*shape, 2, generator=torch.Generator().manual_seed(1)) - 1


def test_gains_are_found_per_mission():
    gains = torch.tensor([[-1.0, 2.0], [0.5, -0.3]])
    u = actions(2, 24)
    fitted, _ = fit_gain(u, gains.unsqueeze(-2) * u, weigh(torch.ones(2, 24, 1), 0.8))
    assert torch.allclose(fitted, gains, atol=5e-3)


def test_weights_equal_plain_weighted_least_squares():
    u, seen = actions(9), actions(3, 9)[0]
    weights = 0.7 ** torch.arange(8.0, -1.0, -1.0)
    by_hand = (weights[:, None] * u * seen).sum(0) / (weights[:, None] * u**2).sum(0)
    assert torch.allclose(fit_gain(u, seen, weigh(torch.ones(9, 1), 0.7))[0], by_hand, atol=1e-2)


def test_without_evidence_the_fit_is_nominal():
    nothing = torch.zeros(24, 2), torch.zeros(24, 2), torch.zeros(24, 1)
    assert torch.allclose(fit_gain(*nothing)[0], torch.ones(2))
    matrix, bias, _ = fit_affine(*nothing)
    assert torch.allclose(matrix, torch.eye(2), atol=1e-5)
    assert torch.allclose(bias, torch.zeros(2), atol=1e-5)


def test_recent_pairs_outweigh_old_ones():
    u = actions(24)
    seen = torch.cat([u[:16], -u[16:]])
    assert (fit_gain(u, seen, weigh(torch.ones(24, 1), 0.5))[0] < -0.9).all()


@pytest.mark.parametrize("form", REGIMES)
def test_the_corrected_action_has_the_planned_effect(line, drive, plans, form):
    corrector = LeastSquares(LOW, HIGH, form=form, forgetting=0.95)
    planned = plans(10, 5, 2, size=0.5)
    (executed, predicted, spread, _, _, misaligned, _), effects = drive(
        corrector, line(2), REGIMES[form], planned
    )
    assert misaligned[1:].all() and not spread.any()
    torch.testing.assert_close(effects[5:], planned[5:], rtol=0, atol=0.02)
    torch.testing.assert_close(predicted[5:], effects[5:], rtol=0, atol=0.02)


def test_what_cannot_be_had_is_predicted_as_it_comes(line, drive, plans):
    corrector = LeastSquares(LOW, HIGH)
    planned = torch.cat([plans(6, 3, 2), HIGH.expand(1, 3, 2)])
    (executed, predicted, *_), effects = drive(corrector, line(2), REGIMES["gain"], planned)
    assert ((executed >= LOW) & (executed <= HIGH)).all()
    torch.testing.assert_close(predicted[-1], effects[-1], rtol=0, atol=0.02)


@pytest.mark.parametrize("form", REGIMES)
@pytest.mark.parametrize("saturation", MODES)
def test_actions_stay_in_the_box(line, drive, plans, form, saturation):
    corrector = LeastSquares(LOW, HIGH, form=form, saturation=saturation)
    (executed, *_), _ = drive(corrector, line(2), lambda sent: 0.01 * sent[-1], plans(5, 7, 2))
    assert ((executed >= LOW - 1e-6) & (executed <= HIGH + 1e-6)).all()
