import pytest
import torch

from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError
from afm_rl.flow import LeastSquares, Window
from afm_rl.flow.least_squares import fit_affine, fit_gain, weigh
from afm_rl.flow.saturation import MODES

LOW, HIGH = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])


def actions(*shape):
    return 2 * torch.rand(*shape, 2, generator=torch.Generator().manual_seed(1)) - 1


def test_gains_are_found_per_mission():
    gains = torch.tensor([[-1.0, 2.0], [0.5, -0.3]])
    u = actions(2, 24)
    fitted = fit_gain(u, gains.unsqueeze(-2) * u, weigh(torch.ones(2, 24, 1), 0.8))
    assert torch.allclose(fitted, gains, atol=5e-3)


def test_an_affine_map_is_found():
    matrix, bias = torch.tensor([[0.6, -0.8], [0.8, 0.6]]), torch.tensor([0.2, -0.1])
    u = actions(24)
    fitted = fit_affine(u, u @ matrix.mT + bias, weigh(torch.ones(24, 1), 0.95))
    assert torch.allclose(fitted[0], matrix, atol=5e-3)
    assert torch.allclose(fitted[1], bias, atol=5e-3)


def test_weights_equal_plain_weighted_least_squares():
    u, seen = actions(9), actions(3, 9)[0]
    weights = 0.7 ** torch.arange(8.0, -1.0, -1.0)
    by_hand = (weights[:, None] * u * seen).sum(0) / (weights[:, None] * u**2).sum(0)
    assert torch.allclose(fit_gain(u, seen, weigh(torch.ones(9, 1), 0.7)), by_hand, atol=1e-2)


def test_without_evidence_the_fit_is_nominal():
    nothing = torch.zeros(24, 2), torch.zeros(24, 2), torch.zeros(24, 1)
    assert torch.allclose(fit_gain(*nothing), torch.ones(2))
    matrix, bias = fit_affine(*nothing)
    assert torch.allclose(matrix, torch.eye(2), atol=1e-5)
    assert torch.allclose(bias, torch.zeros(2), atol=1e-5)


def test_recent_pairs_outweigh_old_ones():
    u = actions(24)
    seen = torch.cat([u[:16], -u[16:]])
    assert (fit_gain(u, seen, weigh(torch.ones(24, 1), 0.5)) < -0.9).all()


@pytest.mark.parametrize("form", ["gain", "affine"])
def test_the_corrected_action_has_the_planned_effect(unknown, form):
    gains, model = torch.tensor([-0.8, 0.9]), Dubins()
    state, executed = torch.zeros(5, 24, 3), actions(5, 24) * HIGH
    seen = Window(
        state, executed, executed, model(state, gains * executed), torch.ones(5, 24).bool()
    )
    corrector = LeastSquares(LOW, HIGH, form=form, forgetting=0.95)
    context = corrector.context(seen, model)
    again = corrector.context(seen, model, context._replace(pairs=context.pairs.roll(1, -2)))
    torch.testing.assert_close(again, context)  # asked about the newest pair only
    begun = corrector.context(seen, model, unknown(corrector, 5))
    assert torch.equal(begun.pairs[:, -1], context.pairs[:, -1]) and not begun.pairs[:, :-1].any()
    assert context.misaligned.all()
    planned = 0.5 * actions(5) * HIGH
    corrected = corrector.correct(context, state[:, 0], planned)
    assert torch.allclose(gains * corrected.action, planned, atol=0.02)
    assert not corrected.spread.any() and corrected.reach is None
    far = corrector.correct(context, state[:, 0], HIGH.expand(5, 2))  # cannot be had
    torch.testing.assert_close(far.expected, gains * far.action, rtol=0, atol=0.02)


@pytest.mark.parametrize("form", ["gain", "affine"])
@pytest.mark.parametrize("saturation", MODES)
def test_actions_stay_in_the_box(shown, form, saturation):
    corrector = LeastSquares(LOW, HIGH, form=form, saturation=saturation)
    context = shown(corrector, actions(7, 24), 0.01 * actions(7, 24))
    corrected = corrector.correct(context, torch.zeros(7, 3), HIGH.expand(7, 2)).action
    assert ((corrected >= LOW - 1e-6) & (corrected <= HIGH + 1e-6)).all()


@pytest.mark.parametrize(
    ("setting", "name"),
    [
        ({"form": "cubic"}, "corrector.form"),
        ({"forgetting": 0.0}, "corrector.forgetting"),
        ({"forgetting": 1.5}, "corrector.forgetting"),
        ({"window": 0}, "corrector.window"),
        ({"saturation": "none"}, "corrector.saturation"),
    ],
)
def test_bad_settings_are_refused(setting, name):
    with pytest.raises(ConfigurationError, match=name):
        LeastSquares(LOW, HIGH, **setting)
