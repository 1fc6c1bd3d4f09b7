"""The inverse of a dynamics model."""

import math

import pytest
import torch

from afm_rl.dynamics import Dubins, KnownDynamics, effective_action
from afm_rl.spaces.manifold import Manifold

HALF = torch.tensor([1.0, 1.5])


def seen(model, state, action, next_state):
    half = HALF.to(state.dtype)
    return effective_action(model, state, action, next_state, half)


@pytest.mark.parametrize("batch", [(), (200,), (4, 6)])
def test_gains_are_recovered_exactly_from_the_nominal_robot(gains, transitions, batch):
    state, action = transitions(*batch, dtype=torch.float64)
    rows = gains.sample(batch, torch.Generator().manual_seed(0)).double()
    found = seen(Dubins(), state, action, Dubins()(state, rows * action))
    torch.testing.assert_close(found.action, rows * action, rtol=1e-4, atol=1e-4)


def test_gains_are_recovered_about_from_an_ensemble(trained_ensemble, gains, transitions):
    state, action = transitions(300)
    rows = torch.tensor([-0.8, 1.2])
    found = seen(trained_ensemble, state, action, Dubins()(state, rows * action))
    miss, nothing = ((part - rows * action) / HALF for part in (found.action, action))
    assert miss.abs().median() < 0.17 * nothing.abs().median()
    # The mean square is that of few where a network's slope misleads: it differs with rounding.
    assert miss.square().mean() < 0.5**2 * nothing.square().mean()


def test_the_innovation_is_the_largest_error_in_standard_deviations():
    model = Dubins(noise_std=0.01)
    state, action = torch.zeros(3), torch.tensor([0.5, 0.5])
    reached = model(state, action) + torch.tensor([0.03, -0.07, 0.02])
    assert float(seen(model, state, action, reached).innovation) == pytest.approx(7, rel=1e-4)


def test_crossing_the_seam_is_no_surprise():
    model = Dubins()
    state = torch.stack([torch.zeros(100), torch.zeros(100), torch.linspace(2.9, 3.14, 100)], -1)
    action = torch.tensor([0.5, 1.5]).expand(100, 2)
    reached = model(state, action)
    assert (reached[:, 2] < 0).sum() > 50
    found = seen(model, state, action, reached)
    assert float(found.innovation.max()) < 0.01
    torch.testing.assert_close(found.action, action, rtol=0, atol=1e-4)


class Scaled(Dubins):
    """Moves by so many times its actions."""

    def __init__(self, *factors):
        super().__init__()
        self.factors = torch.tensor(factors).double()

    def forward(self, state, action):
        return super().forward(state, action * self.factors)

    def jacobian(self, state, action):
        return super().jacobian(state, action) * self.factors


def test_an_axis_without_influence_stays_where_it_is_and_nothing_is_known_of_it(transitions):
    state, action = transitions(30, dtype=torch.float64)
    reached = Dubins()(state, action * torch.tensor([-1.0, 3.0]).double())
    found = seen(Scaled(1.0, 0.0), state, action, reached)
    torch.testing.assert_close(found.action[:, 1], action[:, 1])
    torch.testing.assert_close(found.action[:, 0], -action[:, 0], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found.std[:, 1], torch.full((30,), 4.0).double())  # half ranges


@pytest.mark.parametrize("influence", [1e-3, 1e-2, 1.0])
def test_an_axis_that_shows_little_moves_as_far_as_its_prior_allows(influence):
    """The closed form, C = (J'J + I / 16)^-1, of a model that is affine in its action."""
    model, noise = Scaled(1.0, influence), 1e-3
    state, action = torch.zeros(3).double(), torch.tensor([0.5, 0.2]).double()
    reached = model(state, action) + torch.tensor([0.02, 0.0, 0.01]).double()
    found = seen(model, state, action, reached)
    half = HALF.double()
    slope = model.jacobian(state, action) * half / noise
    covariance = torch.linalg.inv(slope.mT @ slope + torch.eye(2) / 16)
    step = covariance @ slope.mT @ (reached - model(state, action)) / noise
    torch.testing.assert_close(found.action, action + half * step)
    torch.testing.assert_close(found.std, covariance.diagonal().sqrt())


def test_the_unit_of_the_action_does_not_matter(transitions):
    """One that takes v in percent."""
    state, action = transitions(30, dtype=torch.float64)
    unit = torch.tensor([100.0, 1.0]).double()
    reached = Dubins()(state, -0.5 * action) + 0.01
    usual = seen(Dubins(), state, action, reached)
    percent = effective_action(
        Scaled(0.01, 1.0), state, action * unit, reached, HALF.double() * unit
    )
    torch.testing.assert_close(percent.action / unit, usual.action)
    torch.testing.assert_close(percent.innovation, usual.innovation)


@pytest.mark.parametrize("fault", [math.nan, math.inf, -math.inf, 1e30])
@pytest.mark.parametrize("where", [0, 1, 2])
def test_a_faulty_row_does_not_disturb_the_others(trained_ensemble, transitions, fault, where):
    for model in (Dubins(), trained_ensemble):
        state, action = transitions(4)
        reached = Dubins()(state, -action)
        expected = seen(model, state, action, reached)
        parts = [state.clone(), action.clone(), reached.clone()]
        parts[where][2] = fault
        found = seen(model, *parts)
        rows = torch.tensor([0, 1, 3])
        torch.testing.assert_close(found.action[rows], expected.action[rows])
        torch.testing.assert_close(found.innovation[rows], expected.innovation[rows])
        assert all(part.isfinite().all() for part in found)


class Counting(Dubins):
    """Counts how often it is asked."""

    calls = 0
    jacobian = Dubins.jacobian

    def forward(self, state, action):
        self.calls += 1
        return super().forward(state, action)


def test_a_model_that_is_affine_in_the_action_is_asked_once(transitions):
    model = Counting()
    state, action = transitions(5)
    seen(model, state, action, Dubins()(state, -action))
    assert model.calls == 1


def bent(state, action):
    """Bends twice within the box: single Gauss-Newton steps from afar mislead."""
    drive = action + 0.3 * torch.sin(3 * action)
    return state + torch.stack([drive[..., 0] + 0.2 * drive[..., 1].square(), drive[..., 1]], -1)


BENT = KnownDynamics(bent, Manifold(2), 2, noise_std=0.01)


def test_rounds_bring_a_bent_model_to_the_true_action():
    generator = torch.Generator().manual_seed(0)
    executed, true = (2 * torch.rand(2, 400, 2, generator=generator, dtype=torch.float64) - 1) * 0.9
    state = torch.zeros_like(true)
    median = []
    for rounds in (1, 4, 8):
        found = effective_action(BENT, state, executed, bent(state, true), torch.ones(2), rounds)
        median.append(float((found.action - true).abs().amax(-1).median()))
        before, after = (
            (bent(state, true) - bent(state, action)).norm(dim=-1)
            for action in (executed, found.action)
        )
        assert bool((after <= before).all())
    assert median[1] < 0.1 * median[0]
    assert median[2] < 1e-3


def test_a_guess_that_explains_more_leads_out_of_a_local_minimum():
    wavy = KnownDynamics(lambda s, a: s + (3 * a).sin() + 0.1 * a, Manifold(1), 1, noise_std=0.01)
    state, executed, true = torch.zeros(3, 1), -torch.ones(1), torch.tensor([0.9])
    reached = wavy(state, true.expand(3, 1))
    guess = torch.tensor([[-1.0], [0.8], [-0.9]])  # as executed, near the truth, no better
    found = [
        effective_action(wavy, state, executed.expand(3, 1), reached, torch.ones(1), guess=start)
        for start in (None, guess)
    ]
    assert bool(((found[0].action - true).abs() > 0.5).all())
    torch.testing.assert_close(found[1].action[1], true, atol=0.01, rtol=0)
    torch.testing.assert_close(found[1].innovation, found[0].innovation)
    near = 0.8 * torch.ones(1, 1)  # of which a guess that explains less takes nothing
    given = wavy, state[:1], near, reached[:1], torch.ones(1), 1
    plain, worse = (effective_action(*given, guess=start) for start in (None, -near))
    torch.testing.assert_close(worse.action, plain.action)


def test_the_standard_deviation_is_that_of_repeated_transitions():
    generator = torch.Generator().manual_seed(0)
    state, true = torch.zeros(4000, 2).double(), torch.tensor([0.3, -0.2]).double()
    noise = 0.01 * torch.randn(4000, 2, generator=generator, dtype=torch.float64)
    reached = bent(state, true.expand(4000, 2)) + noise
    found = effective_action(BENT, state, true.expand(4000, 2), reached, torch.ones(2))
    torch.testing.assert_close(found.action.std(0), found.std.mean(0), rtol=0.05, atol=0)


def test_a_row_alone_is_found_as_among_others():
    """Rows need a different number of rounds: each ends for itself."""

    def step(state, action):
        return state + action + action**3

    model = KnownDynamics(step, Manifold(2), 2, noise_std=1e-2)
    draw = torch.Generator().manual_seed(0)
    state, action = torch.zeros(40, 2).double(), torch.rand(40, 2, generator=draw).double() - 0.5
    size = 10.0 ** -torch.arange(40).remainder(5).double().unsqueeze(-1)
    worth = action + size * torch.randn(40, 2, generator=draw).double()
    reached = step(state, worth)
    together = seen(model, state, action, reached)
    for row in range(40):
        alone = seen(model, *(part[row] for part in (state, action, reached)))
        for one, many in zip(alone, together, strict=True):
            torch.testing.assert_close(one, many[row], rtol=1e-12, atol=1e-12)


def test_a_step_that_makes_it_worse_is_tried_shorter():
    """From 0.18 the slope of the sine leads too far; a quarter of the step gets over the hill."""
    model = KnownDynamics(lambda s, a: s + (8 * a).sin(), Manifold(1), 1, noise_std=0.01)
    sent, wanted = torch.tensor([0.18]), torch.tensor([0.2])
    found = effective_action(model, torch.zeros(1), sent, wanted, torch.ones(1), rounds=4)
    assert ((8 * found.action).sin() - wanted).abs() < 0.25
    assert ((8 * sent).sin() - wanted).abs() > 0.75


class Traced(KnownDynamics):
    """Notes which actions it is asked about, and where its slope is, which is said to be 1."""

    def __init__(self, effect):
        super().__init__(lambda s, a: s + effect(a), Manifold(1), 1, noise_std=0.01)
        self.asked, self.slopes = [], []

    def forward(self, state, action):
        self.asked.append(action.item())
        return super().forward(state, action)

    def jacobian(self, state, action):
        self.slopes.append(action.item())
        return torch.ones(1, 1)


def test_after_a_step_in_vain_the_next_is_at_most_a_quarter_of_a_half_range():
    model = Traced(lambda a: -2 * a)
    effective_action(model, torch.zeros(1), torch.zeros(1), torch.tensor([9.0]), HALF[:1], rounds=2)
    assert model.asked == [0.0, 1.0, -0.25]


@pytest.mark.parametrize(("slope", "renewed"), [(0.1, [0.0, 0.8]), (0.4, [0.0])])
def test_the_slope_is_taken_anew_after_a_step_that_gains_less_than_half_of_its_promise(
    slope, renewed
):
    """Of an effect that has less slope from .1 on, 38 % and 72 % are gained."""
    model = Traced(lambda a: torch.minimum(a, 0.1 + slope * (a - 0.1)))
    effective_action(model, torch.zeros(1), torch.zeros(1), torch.tensor([0.8]), HALF[:1], rounds=2)
    assert model.slopes == pytest.approx(renewed, abs=1e-4)


@pytest.mark.parametrize(("left", "grown"), [(0.5, 1.0), (3.0, 3.0 / math.sqrt(2)), (90.0, None)])
def test_what_no_action_explains_makes_it_less_sure(left, grown):
    """The second coordinate is beyond the action's reach."""
    model = KnownDynamics(lambda s, a: s + torch.cat([a, 0 * a], -1), Manifold(2), 1, noise_std=1.0)
    seen = torch.tensor([0.5, left])
    found = effective_action(model, torch.zeros(2), torch.zeros(1), seen, torch.ones(1))
    exact = (1 + 1 / 16) ** -0.5
    wanted = 4.0 if grown is None else exact * max(1.0, grown)
    torch.testing.assert_close(found.std, torch.tensor([wanted]), rtol=0.01, atol=0)
