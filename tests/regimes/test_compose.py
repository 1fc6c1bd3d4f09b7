"""Families of regimes one after the other."""

import pytest
import torch
from harness import refused
from test_regime_families import FAMILIES

from afm_rl.errors import ConfigurationError
from afm_rl.regimes import ActionGain, Backlash, Compose, Delay, Lag
from afm_rl.regimes.base import Regime

LOW, HIGH = torch.full((2,), -1.0), torch.ones(2)


class Shift(Regime):
    """Adds a number to both axes: not a gain, and no closed inverse."""

    names, identity = ("bias",), (0.0,)

    def apply(self, action, parameters, state, past=None, noise=None):
        return action + parameters

    def sample(self, shape, generator=None):
        return torch.rand((*shape, 1), generator=generator)


def test_a_family_without_a_prior_says_so_when_it_is_drawn_from():
    class Offset(Shift):
        sample = Regime.sample

    with pytest.raises(ConfigurationError, match=r"Offset: has no prior .* give it span"):
        Offset().sample((3,))


@pytest.fixture
def both(gains):
    return Compose([gains, Shift()])


def test_the_first_family_acts_first(both, gains):
    row = both.encode({"v_gain": 2.0, "bias": 0.5})
    assert row.tolist() == [2.0, 1.0, 0.5]
    assert both.apply(torch.ones(2), row, torch.zeros(3)).tolist() == [2.5, 1.5]
    reverse = Compose([Shift(), gains])
    row = reverse.encode({"v_gain": 2.0, "bias": 0.5})
    assert reverse.apply(torch.ones(2), row, torch.zeros(3)).tolist() == [3.0, 1.5]


@pytest.mark.parametrize("families", [[], [ActionGain(["a"]), ActionGain(["a"])]], ids=["0", "2"])
def test_families_need_distinct_names(families):
    with pytest.raises(ConfigurationError, match="distinct parameter names"):
        Compose(families)


@pytest.fixture
def robot():
    """All kinds of families: with history, noise and closed forms."""
    return FAMILIES["composed"]


def test_history_and_noise_are_those_of_the_families(robot, both):
    assert (robot.history, robot.noisy) == (25, True)
    assert (both.history, both.noisy) == (0, False)
    row = robot.encode({"delay": 1.0, "gain_noise": 0.5})
    past = torch.tensor([[0.4, -0.2], *[[0.0, 0.0]] * 9])
    effect = robot.apply(torch.ones(2), row, torch.zeros(3), past, torch.tensor([1.0, -1.0]))
    torch.testing.assert_close(effect, torch.tensor([0.6, -0.1]))


def test_the_prior_draws_the_families_of_one_of_its_lists(robot):
    rows = robot.sample((6000,), torch.Generator().manual_seed(0))
    assert rows.shape == (6000, 8)
    changed = rows != torch.tensor(robot.identity)
    kinds = {
        "dead_zone": changed[:, 1],
        "rotation": changed[:, 2],
        "gain": changed[:, 3:5].any(-1),
        "bias": changed[:, 6:].any(-1),
    }
    assert not changed[:, 0].any() and not changed[:, 5].any()  # delay and noise are in no list
    assert torch.equal(kinds["dead_zone"], kinds["bias"])
    assert not (kinds["bias"] & (kinds["gain"] | kinds["rotation"])).any()
    for name in ("dead_zone", "rotation"):
        assert float(kinds[name].float().mean()) == pytest.approx(1 / 3, abs=0.02)
    again = robot.sample((6000,), torch.Generator().manual_seed(0))
    assert torch.equal(rows, again)


def test_named_families_are_drawn_and_the_others_stay_nominal(robot):
    rows = robot.draw(["bias", "delay"], (5, 2), torch.Generator().manual_seed(0))
    changed = (rows != torch.tensor(robot.identity)).flatten(0, 1).all(0)
    assert changed.tolist() == [True] + [False] * 5 + [True] * 2


def test_only_rows_with_a_family_without_a_closed_form_are_searched(both):
    rows = torch.tensor([[2.0, 1.0, 0.0], [2.0, 1.0, 0.3], [-1.0, 0.5, 0.0]])
    wanted = torch.tensor([[0.6, -0.2]])
    found = both.inverse(wanted, rows, torch.zeros(3), LOW, HIGH)
    torch.testing.assert_close(found[[0, 2]], torch.tensor([[0.3, -0.2], [-0.6, -0.4]]))
    torch.testing.assert_close(found[1], torch.tensor([0.15, -0.5]), rtol=0, atol=2e-3)


def test_families_that_depend_on_previous_actions_follow_each_other():
    both = Compose(
        {"delay": Delay(), "lag": Lag(history=4), "backlash": Backlash([1.0, 1.0], history=2)}
    )
    assert both.history == 31
    commands = torch.randn(40, 2, generator=torch.Generator().manual_seed(0))
    row = both.encode({"delay": 2, "lag": 1.5, "backlash": 0.1})
    t, newest_first = 39, commands.flip(0)

    def late(step):
        return commands[step - 2]

    def slow(step):
        past = torch.stack([late(step - k) for k in range(1, 5)])
        return Lag(history=4).apply(late(step), torch.tensor([1.5]), torch.zeros(3), past)

    past = torch.stack([slow(t - 1), slow(t - 2)])
    loose = Backlash([1.0, 1.0], history=2)
    expected = loose.apply(slow(t), torch.tensor([0.1]), torch.zeros(3), past)
    rows = commands[t].expand(3, 2), row.expand(3, -1), torch.zeros(3, 3)
    found = both.apply(*rows, newest_first[1:32].expand(3, 31, 2))
    torch.testing.assert_close(found, expected.expand(3, 2))


def test_nominal_families_cost_no_bit_and_change_no_shape(robot, gains):
    rows = gains.sample((50,), torch.Generator().manual_seed(0))
    action = torch.rand(50, 2, generator=torch.Generator().manual_seed(1))
    whole = robot.encode({}).repeat(50, 1)
    assert torch.equal(robot.apply(action, whole, torch.zeros(50, 3)), action)
    assert robot.apply(action[0], whole, torch.zeros(3)).shape == (50, 2)
    assert robot.inverse(action[0], whole, torch.zeros(3), LOW, HIGH).shape == (50, 2)
    whole[:, 3:5] = rows
    effect = robot.apply(action, whole, torch.zeros(50, 3))
    assert torch.equal(effect, gains.apply(action, rows, torch.zeros(50, 3)))


def test_families_check_their_own_values(robot):
    assert robot.encode({"delay": 2, "v_gain": -1.0}).tolist() == [2, 0, 0, -1, 1, 0, 0, 0]
    assert robot.describe(robot.encode({"v_bias": 0.1, "delay": 1})) == "delay = 1, v_bias = 0.1"
    with pytest.raises(ConfigurationError, match="delay=1.5: expected whole steps"):
        robot.encode({"delay": 1.5})
    with pytest.raises(ConfigurationError, match="unknown parameter 'dealy'; allowed: delay"):
        robot.encode({"dealy": 1.0})


@refused(
    ({"regimes": {"gain": "ActionGain"}}, "gain='ActionGain': expected a Regime"),
    ({"regimes": {"b": Shift(), "late": Delay()}}, "late depend on previous actions"),
    ({"prior": []}, r"prior=\[\]: expected at least one list"),
    ({"prior": [["nope"]]}, "family='nope': expected one of delay, shift"),
    ({"prior": ["delay"]}, "'delay': expected a list of families"),
    ({"prior": [3]}, "3: expected a list of families"),
)
def test_families_that_do_not_go_together_are_refused(settings):
    Compose(**{"regimes": {"delay": Delay(), "shift": Shift()}, **settings})
