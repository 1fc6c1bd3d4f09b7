"""A nominal model plus what it misses of a robot: closed forms of the fit, and the model."""

import pytest
import torch

from afm_rl.dynamics import Dubins, DynamicsModel, KnownDynamics, LinearResidual, Quadrotor
from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.learning.residual_fit import relevant_coordinates, residual_parts
from afm_rl.spaces.manifold import Manifold


def draw(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def push(state, action):  # position and speed of two carts
    place, speed = state.chunk(2, -1)
    return torch.cat([place + 0.1 * speed, speed + 0.1 * action - 0.02 * speed], -1)


CARTS = KnownDynamics(push, Manifold(4), 2, noise_std=1e-3)


def with_residual(base, missions=None, fitted=True):
    """Return a model with a residual that was fitted to nothing in particular."""
    model = LinearResidual(base).double()
    if missions is not None:
        model.expand_(missions)
    shapes = {name: part.shape for name, part in model.named_buffers(recurse=False)}
    sizes = {"mean": 0.1, "weights": 0.02, "noise": 0.0}
    drawn = {name: size * draw(*shapes[name], seed=len(name)) for name, size in sizes.items()}
    drawn["std"] = 1 + 0.5 * draw(*shapes["std"]).tanh()
    return model.fitted_(**drawn, steps=torch.full(model.lead, 100 * fitted))


def fit(state, action, after, base=CARTS):
    relevant = relevant_coordinates(base, state, action)
    return residual_parts(base.manifold, state, base(state, action), after, relevant)


def test_a_linear_mismatch_is_recovered():
    def robot(state, action):
        """Have other damping, mass and a slope: linear in speed and in the model's motion."""
        speed = torch.cat([0 * state[:, 2:], 0.05 * state[:, 2:]], -1)
        slope = torch.tensor([0.0, 0.0, 0.03, -0.02])
        return state + 0.9 * (push(state, action) - state) + speed + slope

    state, action = draw(100, 4), draw(100, 2, seed=1)
    model = LinearResidual(CARTS).fitted_(**fit(state, action, robot(state, action)))
    there, act = 0.5 * draw(50, 4, seed=2), 0.5 * draw(50, 2, seed=3)
    missed, idle = ((m(there, act) - robot(there, act)).abs().amax(0) for m in (model, CARTS))
    assert bool((missed < 0.03 * idle).all())
    assert bool((model.explained > 0.99).all())


def test_nothing_is_adjusted_that_does_not_improve():
    state, action = draw(100, 4), draw(100, 2, seed=1)
    noise = 0.05 * draw(100, 4, seed=2)
    parts = fit(state, action, push(state, action) + noise)
    assert bool((parts["explained"] <= 0.1).all())
    kept = parts["explained"] == 0
    assert kept.sum() >= 3 and not bool(parts["weights"][:, kept].any())
    torch.testing.assert_close(parts["noise"][kept], noise.square().mean(0).sqrt()[kept])
    exact = fit(state, action, push(state, action))
    assert not bool(exact["weights"].any()) and not bool(exact["noise"].any())


def test_what_improves_in_three_quarters_of_the_time_only_is_left_alone():
    state, action = draw(200, 4), draw(200, 2, seed=1)
    after = push(state, action)
    sign = torch.ones(200, 1).double()
    sign[:50] = -1
    after[:, 2:] += sign * 0.1 * (after - state)[:, 2:]
    assert not bool(fit(state, action, after)["weights"].any())


def test_positions_on_flat_ground_are_left_out():
    state, action = draw(100, 4), draw(100, 2, seed=1)
    assert relevant_coordinates(CARTS, state, action).tolist() == [False, False, True, True]
    assert relevant_coordinates(Dubins(), draw(20, 3), draw(20, 2)).tolist() == [False, False, True]
    after = push(state, action) + 0.1 * state[:, :1]  # a slope that the place alone would explain
    assert not bool(fit(state, action, after)["weights"][1:3].any())


def test_robots_of_a_batch_are_fitted_one_by_one():
    state, action = draw(3, 100, 4), draw(3, 100, 2, seed=1)
    gains = torch.tensor([0.8, 1.0, 1.2]).double()[:, None, None]
    after = state + gains * (push(state, action) - state)
    parts = fit(state, action, after)
    model = LinearResidual(CARTS).expand_(3).fitted_(**parts)
    for k in range(3):
        alone = LinearResidual(CARTS).fitted_(**fit(state[k], action[k], after[k]))
        torch.testing.assert_close(model(state, action)[k], alone(state[k], action[k]))
        torch.testing.assert_close(model.of(k)(state[k], action[k]), alone(state[k], action[k]))


def test_nothing_is_extrapolated_beyond_four_standard_deviations():
    model = with_residual(CARTS)
    assert model.lead == ()
    far, farther = (k * torch.ones(1, 4).double() for k in (1e4, 1e5))
    act = torch.zeros(1, 2).double()
    added = [model(s, act) - CARTS(s, act) for s in (far, farther)]
    torch.testing.assert_close(*added, rtol=0, atol=1e-6)


@pytest.mark.parametrize("base", [CARTS, Dubins(), Quadrotor()], ids=["carts", "car", "quadrotor"])
def test_before_the_fit_it_is_the_nominal_model(base):
    base, model = base.double(), LinearResidual(base.double())
    state, action = base.manifold.project(draw(5, base.state_size)), draw(5, base.action_size).abs()
    robots = LinearResidual(base).expand_(5)
    some = robots.fitted_(torch.arange(5) == 2, steps=torch.tensor(100), noise=torch.tensor(0.5))
    for one in (model, some):
        for name in ("forward", "jacobian", "noise_scale"):
            kept = torch.tensor([True, True, one is model, True, True])
            found, nominal = (getattr(m, name)(state, action)[kept] for m in (one, base))
            assert torch.equal(found, nominal), name
    assert some.noise_scale(state, action)[2].min() == 0.5


def test_a_residual_can_be_saved_and_loaded(tmp_path):
    path, model = tmp_path / "robot.safetensors", with_residual(CARTS)
    model.save(path)
    again = LinearResidual.load(path, CARTS)
    state, action = draw(9, 4), draw(9, 2)
    assert torch.equal(again(state, action), model(state, action))
    assert torch.equal(again.noise_scale(state, action), model.noise_scale(state, action))
    with pytest.raises(ArtefactError, match="nominal model that it was fitted with"):
        LinearResidual.load(path, Dubins())
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(ArtefactError, match="damaged"):
        LinearResidual.load(path, CARTS)
    with pytest.raises(ConfigurationError, match="no such file"):
        LinearResidual.load(tmp_path / "other", CARTS)
    with pytest.raises(ConfigurationError, match="has a residual already"):
        LinearResidual(model)


def test_the_state_dict_has_what_was_fitted():
    model, other = with_residual(CARTS), LinearResidual(CARTS).double()
    other.load_state_dict(model.state_dict())
    state, action = draw(9, 4), draw(9, 2)
    assert torch.equal(other(state, action), model(state, action))


def test_derivatives_of_a_quadrotor_are_those_of_the_prediction():
    model = with_residual(Quadrotor().double())
    state, action = model.manifold.project(draw(4, 13)), 0.1 * draw(4, 4).abs() + 0.05
    slow = type("Slow", (LinearResidual,), {"forward": LinearResidual.forward})
    found, model.__class__ = model.jacobian(state, action), slow
    assert slow.jacobian is DynamicsModel.jacobian
    torch.testing.assert_close(found, model.jacobian(state, action))
