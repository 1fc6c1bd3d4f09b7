"""Families of regimes one after the other."""

import pytest
import torch

from afm_rl.errors import ConfigurationError
from afm_rl.regimes import ActionGain, Compose
from afm_rl.regimes.base import Regime

LOW, HIGH = torch.full((2,), -1.0), torch.ones(2)


class Bias(Regime):
    """Adds a number to both axes: not a gain, and no closed inverse."""

    names, identity = ("bias",), (0.0,)

    def apply(self, action, parameters, state):
        return action + parameters

    def sample(self, shape, generator=None):
        return torch.rand((*shape, 1), generator=generator)


@pytest.fixture
def both(gains):
    return Compose([gains, Bias()])


def test_the_first_family_acts_first(both, gains):
    row = both.encode({"v_gain": 2.0, "bias": 0.5})
    assert row.tolist() == [2.0, 1.0, 0.5]
    assert both.apply(torch.ones(2), row, torch.zeros(3)).tolist() == [2.5, 1.5]
    reverse = Compose([Bias(), gains])
    row = reverse.encode({"v_gain": 2.0, "bias": 0.5})
    assert reverse.apply(torch.ones(2), row, torch.zeros(3)).tolist() == [3.0, 1.5]


def test_names_and_nominal_values_are_joined(both):
    assert both.names == ("v_gain", "omega_gain", "bias")
    assert both.identity == (1.0, 1.0, 0.0)
    assert bool(both.is_identity(both.encode({})))
    action = torch.tensor([0.3, -0.2])
    assert torch.equal(both.apply(action, both.encode({}), torch.zeros(3)), action)


def test_every_family_is_drawn(both):
    drawn = both.sample((7, 2), torch.Generator().manual_seed(0))
    assert drawn.shape == (7, 2, 3)
    assert (drawn[..., 2] >= 0).all() and (drawn[..., :2].abs() >= 0.05).all()


def test_the_inverse_is_found_by_search(both):
    row = both.encode({"v_gain": -2.0, "omega_gain": 1.5, "bias": 0.2})
    wanted = torch.tensor([[0.5, -0.4], [-1.0, 0.9], [0.0, 0.0]])
    found = both.inverse(wanted, row.expand(3, 3), torch.zeros(3, 3), LOW, HIGH)
    exact = (wanted - 0.2) / row[:2]
    torch.testing.assert_close(found, exact, rtol=0, atol=2e-3)


def test_the_search_serves_a_single_action_and_stays_in_the_box(both):
    row = both.encode({"v_gain": 0.1})
    found = both.inverse(torch.tensor([0.9, 0.3]), row, torch.zeros(3), LOW, HIGH)
    torch.testing.assert_close(found, torch.tensor([1.0, 0.3]), rtol=0, atol=2e-3)


@pytest.mark.parametrize("families", [[], [ActionGain(["a"]), ActionGain(["a"])]], ids=["0", "2"])
def test_families_need_distinct_names(families):
    with pytest.raises(ConfigurationError, match="distinct parameter names"):
        Compose(families)
