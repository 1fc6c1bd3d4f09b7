"""What networks read in a context, and how they mix it with what they know."""

import pytest
import torch

from afm_rl.flow import ContextFlow
from afm_rl.flow.hints import GUESSES
from afm_rl.flow.network import blend
from afm_rl.flow.reading import Reading


@pytest.fixture
def known(flow):
    return flow.read(torch.randn(3, flow.feature_size, generator=torch.Generator().manual_seed(0)))


def test_what_is_packed_comes_out_again(flow, known):
    packed = known.pack()
    assert packed.shape == (3, flow.context_size // len(flow.views))
    again = Reading.unpack(packed, flow.latent, flow.shown, flow.action_size)
    torch.testing.assert_close(again.code, known.code)
    for found, expected in zip(again.fits, known.fits, strict=True):
        assert found.shape == expected.shape
        torch.testing.assert_close(found, expected.float(), rtol=1e-6, atol=1e-6)


def test_guesses_are_what_the_fits_answer(flow, known):
    unit = torch.tensor([0.3, -0.4]).expand(3, 2)
    answers = known.fits.effect(unit).unflatten(-1, (-1, 2))[:, :GUESSES]
    torch.testing.assert_close(known.guesses(known.of_effect(unit)), answers)


def test_a_share_of_one_is_exact_and_equal_shares_are_the_mean():
    guesses = torch.tensor([[2.0, -1.0], [4.0, 1.0]])
    own = torch.tensor([6.0, 3.0])
    logits = torch.tensor([[0.0, 9.0], [9.0, 0.0], [0.0, 0.0]])  # own and two guesses, per axis
    found = blend(torch.cat([own, logits.flatten()]), guesses)
    torch.testing.assert_close(found, torch.tensor([2.0, 3.0]))
    found = blend(torch.cat([own, torch.zeros(6)]), guesses)
    torch.testing.assert_close(found, torch.tensor([4.0, 1.0]))


@pytest.mark.parametrize("steps", [1, 5])
def test_a_flow_that_trusts_a_guess_ends_there(box, steps):
    """The path to a guess is straight, so one step is as good as many."""
    flow = ContextFlow(*box, window=4, memory=9, hidden=[16], latent=8, steps=steps)
    gain = 1  # the one with long memory
    last = flow.velocity[-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.zero_()
        last.bias.view(-1, 2)[2 + gain] = 9.0  # its own answer, its logit, those of the guesses
    executed = torch.tensor([[0.9, -0.4], [-0.5, 0.8], [0.7, 0.6], [-0.8, -0.7]])
    rows = torch.cat([executed, -2 * executed, torch.ones(4, 1)], -1)
    planned = torch.tensor([0.6, -0.8]) * flow.half_range
    found = flow.correct(flow.told(rows.flatten()), None, planned)
    torch.testing.assert_close(found.action, -planned / 2, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(found.spread, torch.zeros(2), rtol=0, atol=1e-4)


def test_the_mean_can_be_asked_for(box):
    features = torch.randn(5, 20)
    found = {}
    for choose in ("mean", "best"):
        flow = ContextFlow(*box, window=4, memory=9, hidden=[16], latent=8, choose=choose)
        context = flow.told(features)
        found[choose] = flow.correct(context, None, torch.zeros(5, 2)).action
    known = flow.read(features.unsqueeze(-2))
    with torch.no_grad():
        mean = flow._ends(known, torch.zeros(5, 2)).mean(-2)
    torch.testing.assert_close(found["mean"], flow.denormalise(mean.clamp(-1, 1)))
    assert not torch.allclose(found["mean"], found["best"])
