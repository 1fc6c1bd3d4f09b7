"""The fast learner: least squares on the calibration of a model."""

import pytest
import torch
from harness import transition

from afm_rl.dynamics import Calibrated, Dubins
from afm_rl.learning import GaussianNLLLoss, RLSUpdater
from afm_rl.learning.rls_updater import advance, no_fit

HALF = torch.tensor([1.0, 1.5], dtype=torch.float64)
EYE = torch.eye(2, dtype=torch.float64)


class World:
    """A robot whose actuators do what they are told to, and its learner."""

    def __init__(self, missions=None, seed=0, model=None, dtype=torch.float64, **settings):
        self.model = Calibrated(model or Dubins(), HALF.to(dtype)).to(dtype)
        if missions is not None:
            self.model.expand_(missions)
        self.updater = RLSUpdater(GaussianNLLLoss(self.model), **settings)
        self.draw, self.dtype = torch.Generator().manual_seed(seed), dtype
        self.errors = []

    def drive(self, steps, matrix=EYE, bias=0.0, wind=0.0, batch=None):
        """Take random actions; remember how well each was predicted, ``(*batch)``."""
        batch = self.model.lead if batch is None else batch
        for _ in range(steps):
            state, unit = (
                2 * torch.rand(*batch, size, generator=self.draw, dtype=self.dtype) - 1
                for size in (3, 2)
            )
            worth = (matrix.to(self.dtype) @ unit.unsqueeze(-1)).squeeze(-1) + bias
            action = unit * self.model.half_range
            after = Dubins()(state, worth * self.model.half_range) + wind
            error = self.model.manifold.difference(after, self.model(state, action)).norm(dim=-1)
            self.errors.append(error)
            td = transition(state, action, after)
            sound = torch.ones(batch, dtype=torch.bool)  # also where the robot did not move
            self.updater(td.set(("next", "guard", "sound"), sound))

    def recovered(self, since, level=1e-5):
        """Return the steps after ``since`` until errors stay low."""
        errors = torch.stack(self.errors[since:])
        late = errors.reshape(len(errors), -1).amax(-1) > level
        return 1 + int(late.nonzero().max()) if bool(late.any()) else 0

    @property
    def plain(self):
        """Is the calibration the identity, exactly?"""
        model = self.model
        told = torch.equal(model.matrix, EYE.to(self.dtype).expand_as(model.matrix))
        return told and not model.bias.any() and not model.offset.any()


GAINS = torch.diag(torch.tensor([-1.0, 0.5], dtype=torch.float64))
TURN = torch.tensor([[0.5, -0.9], [0.9, 0.5]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("regime", "steps"),
    [
        ({"matrix": GAINS}, 5),
        ({"matrix": TURN}, 8),
        ({"bias": torch.tensor([0.3, -0.2], dtype=torch.float64)}, 8),
        ({"matrix": TURN @ GAINS, "bias": torch.tensor([0.3, -0.2], dtype=torch.float64)}, 10),
    ],
    ids=["gains", "coupling", "bias", "affine"],
)
def test_regimes_are_learnt_and_left_again(regime, steps):
    world = World(missions=3)
    world.drive(20)
    assert world.plain and not torch.stack(world.errors).any()
    world.drive(30, **regime)
    assert 2 <= world.recovered(20, level=1e-4) <= steps
    world.drive(5)
    assert world.recovered(50, level=0.0) == 1 and world.plain
    world.drive(20, **regime)
    world.drive(20, matrix=-TURN)  # straight into another one
    torch.testing.assert_close(world.model.matrix, -TURN.expand_as(world.model.matrix))
    world.updater.start()
    assert world.updater.memory["matched", "age"].tolist() == [0] * 3


def test_the_recursion_is_weighted_least_squares():
    draw = torch.Generator().manual_seed(0)
    features, y = (torch.randn(5, 9, 1, n, generator=draw).double() for n in (3, 2))
    weight = torch.rand(5, 9, 1, 2, generator=draw).double() + 1e3
    yes, prior = torch.ones(5, 1).bool(), torch.rand(5, 2, 3, generator=draw).double()
    fit = no_fit(5, 2, 3)
    for row in zip(*(part.split(1, 1) for part in (features, y, weight)), strict=True):
        gate = 1e9 if bool(fit.age.all()) else 1e-3  # a change only at first
        fit = advance(fit, *row, yes, prior, forgetting=0.9, gate=gate)
    theta, covariance = fit.solution(prior)
    root = (weight.squeeze(2) * (0.9 ** torch.arange(8, -1, -1)).unsqueeze(-1)).sqrt()
    for g in range(2):
        rows = root[..., g, None] * features.squeeze(2)
        tall = torch.cat([rows, torch.diag_embed(prior[:, g].sqrt())], 1)
        wide = torch.cat([root[..., g] * y[..., 0, g], torch.zeros(5, 3)], 1).unsqueeze(-1)
        expected = torch.linalg.lstsq(tall, wide).solution.squeeze(-1)
        torch.testing.assert_close(theta[:, g], expected)
        torch.testing.assert_close(
            covariance[:, g] @ (tall.mT @ tall), torch.eye(3).double().expand(5, 3, 3)
        )


def test_a_fit_of_few_transitions_is_not_judged():
    row, yes = torch.ones(1, 1, 1, 1).double(), torch.ones(1, 1).bool()
    fit, ages = no_fit(1, 1, 1), []
    for size in (10.0, -20.0, 10.0, -20.0):  # nothing explains these
        fit = advance(fit, row, size * row, row, yes, torch.full((1, 1, 1), 1e6))
        ages.append(int(fit.age))
    assert ages == [1, 2, 3, 1]


@pytest.mark.parametrize("regime", [{}, {"matrix": GAINS}], ids=["nominal", "changed"])
def test_an_outlier_does_harm_for_a_few_steps(regime):
    world = World()
    world.drive(20, **regime)
    world.drive(1, wind=torch.tensor([20.0, -20.0, 0.5]), **regime)
    world.drive(40, **regime)
    assert world.recovered(21) <= 20


def test_what_no_action_explains_becomes_the_offset():
    wind = torch.tensor([0.03, -0.05, 0.0], dtype=torch.float64)
    for part in ("unmatched", "all"):
        world = World(missions=3, part=part)
        world.drive(10)
        world.drive(25, wind=wind)
        torch.testing.assert_close(world.model.offset, wind.expand(3, 3), atol=1e-4, rtol=0)
        assert world.errors[-1].max() < 1e-3
        world.drive(20)
        assert not world.model.offset.any() and world.errors[-1].max() < 1e-3
    world = World(part="matched")
    world.drive(30, wind=wind)
    assert not world.model.offset.any()


def test_the_unmatched_part_leaves_actions_alone():
    world = World(part="unmatched")
    world.drive(30, matrix=GAINS)
    assert world.plain


@pytest.mark.parametrize(
    ("batch", "dtype"), [((), torch.float32), ((4,), torch.float64), ((2, 3), torch.float32)]
)
def test_one_calibration_learns_from_simultaneous_transitions(batch, dtype):
    world = World(dtype=dtype)
    world.drive(8, matrix=TURN, batch=batch)
    torch.testing.assert_close(world.model.matrix, TURN.to(dtype), atol=1e-3, rtol=0)


def test_a_learned_base_is_put_right(trained_ensemble):
    world = World(model=trained_ensemble, dtype=torch.float32)
    world.drive(30)
    nominal = torch.stack(world.errors).mean()
    world.drive(30, matrix=GAINS)
    assert torch.stack(world.errors[-10:]).mean() < 3 * nominal
    assert not any(p.grad is not None for p in world.model.parameters())


def test_what_was_learnt_keeps_its_digits():
    world, other = World(), World()
    for each in (world, other):
        each.drive(10, matrix=GAINS)
    other.updater.float()
    other.model.double()
    for each in (world, other):
        each.drive(3, matrix=GAINS)
    torch.testing.assert_close(other.model.matrix, world.model.matrix, atol=1e-6, rtol=0)
