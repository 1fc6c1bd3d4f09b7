"""Known dynamics plus a pool of networks: derivatives, pool, missions."""

import copy
import math

import pytest
import torch
from harness import flights

from afm_rl.dynamics import KNODE, KnownDynamics, Quadrotor
from afm_rl.dynamics.residual import Network
from afm_rl.spaces.airframe import QuadrotorBody
from afm_rl.spaces.manifold import Manifold


def car_rate(state, action):
    heading, speed = state[..., 2:], action[..., :1]
    return torch.cat([speed * heading.cos(), speed * heading.sin(), action[..., 1:]], -1)


def cart_step(state, action):
    return state + 0.1 * torch.cat([state[..., 1:], action], -1)


def full(networks=3, **settings):
    """Return a quadrotor with several networks, also with biases."""
    model = KNODE(Quadrotor(**settings.pop("nominal", {})), **settings)
    generator = torch.Generator().manual_seed(9)
    for _ in range(networks):
        network = model.draw(torch.randn(model.numbers, generator=generator))
        model.push_(
            Network(*(p + 0.1 * torch.randn(p.shape, generator=generator) for p in network))
        )
    return model


def constant(model, *values):
    """Return a network that gives the same whatever it is shown."""
    network = model.draw(torch.zeros(model.numbers))
    return network._replace(outer_bias=torch.tensor([values]))


def test_the_networks_are_the_published_ones():
    model = KNODE(Quadrotor()).push_()
    assert sum(part[0].numel() for part in model.networks) == 1997
    first = model.networks
    assert not first.inner_bias.any() and not first.outer_bias.any()
    bound = math.sqrt(6 / (17 + 64))
    assert 0.95 * bound < first.inner[0].abs().max() <= bound
    assert float(first.inner[0].std()) == pytest.approx(bound / math.sqrt(3), rel=0.05)  # uniform
    assert not torch.equal(*model.push_().networks.inner[:2])


def test_without_networks_it_is_the_nominal_model():
    state, action = flights(7)
    model, nominal = KNODE(Quadrotor(), substeps=2), Quadrotor(substeps=2)
    torch.testing.assert_close(model.linearise(state, action), nominal.linearise(state, action))
    torch.testing.assert_close(model(state, action), nominal(state, action))
    torch.testing.assert_close(model.moments(state, action), nominal.moments(state, action))
    assert torch.equal(model.noise_scale(state, action), nominal.noise_scale(state, action))


def test_the_newest_network_counts_most_and_the_oldest_leaves():
    model = KNODE(KnownDynamics(cart_step, Manifold(2), 1), lambda x, u: 0 * x, dt=1.0, pool=3)
    state, action = torch.zeros(2), torch.zeros(1)
    for count in range(1, 6):
        model.push_(constant(model, float(10**count), 0.0))
        found = model(state, action)[0]
        newest = [10.0**k for k in range(count, max(0, count - 3), -1)]
        expected = sum(x * math.exp(-i) for i, x in enumerate(newest))
        torch.testing.assert_close(found, torch.tensor(expected))


def test_what_is_lost_along_the_body_stays_so_while_it_turns():
    """Half of the mass, seen in one attitude, is half of the mass in every other."""
    heavy, light = Quadrotor(), Quadrotor(QuadrotorBody(mass=0.015))
    state, action = flights(6)
    state[:, 10:], action[:, 1:], action[:, 0] = 0.0, 0.0, 0.2
    model = KNODE(heavy, frame="body").double()
    more = [0.0] * 13
    more[5] = 0.2 / 0.015 - 0.2 / 0.03  # along the body's z axis, m/s^2
    model.push_(constant(model, *more))
    torch.testing.assert_close(model(state, action), light(state, action), rtol=0, atol=1e-6)
    model = KNODE(heavy).double()
    model.push_(constant(model, *more))
    assert (model(state, action) - light(state, action)).abs().max() > 0.1


def test_a_network_can_be_tried_before_it_is_pushed():
    model, (state, action) = full(2), flights(3)
    network = model.draw(torch.randn(model.numbers))
    tried = model.advance(state, action, 0.05, newest=network)
    slope = model.slope(state, action, network)
    model.push_(network)
    torch.testing.assert_close(tried, model(state, action))
    torch.testing.assert_close(slope, model.slope(state, action))


def test_only_the_newest_learns():
    model, (state, action) = full(), flights(3)
    model(state, action).square().sum().backward()
    for part in model.networks:
        assert part.grad[0].any() and not part.grad[1:].any()
    model.push_()
    assert all(part.grad is None for part in model.networks)


def test_missions_have_pools_of_their_own():
    model = full(2)
    several, (state, action) = copy.deepcopy(model).expand_(3), flights(3, 4)
    torch.testing.assert_close(several(state, action), model(state, action))
    several.push_(where=torch.tensor([True, False, True]))
    assert torch.equal(several.networks.inner[1], model.networks.inner)
    assert torch.equal(several.networks.inner[0], several.networks.inner[2])
    assert torch.equal(several.networks.inner[0, 1:], model.networks.inner[:-1])
    none = several.select_(torch.tensor([], dtype=torch.int64))
    assert none(state[:0], action[:0]).shape == (0, 4, 13)
