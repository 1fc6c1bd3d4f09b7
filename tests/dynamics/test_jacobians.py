"""Derivatives of all models against automatic ones, in reverse, of the prediction."""

import pytest
import torch
from harness import flights, grown_apart
from test_calibrated import calibrated
from test_knode import car_rate, full
from test_linear_residual import with_residual

from afm_rl.dynamics import KNODE, Dubins, DynamicsModel, Oracle, Quadrotor
from afm_rl.regimes import Regime, flight_regimes


class Slope(Regime):
    """Actions count the more the farther along x."""

    names, identity, by_state = ("slope",), (0.0,), True

    def effect_of(self, action, parameters, state):
        return action * (1 + parameters * state[..., :1])

    def sample(self, shape, generator=None):
        return torch.rand(*shape, 1, generator=generator)


def told(model, regime, *missions):
    """Return an oracle with a regime, or with one for each mission."""
    oracle = Oracle(model, regime)
    oracle.set_regime(regime.sample(missions, torch.Generator().manual_seed(1)).double())
    return oracle


CARS = {
    "Dubins": lambda ensemble, gains: Dubins(),
    "an ensemble": lambda ensemble, gains: ensemble(),
    "ensembles of missions": lambda ensemble, gains: grown_apart(ensemble().expand_(2)),
    "one with layer norms": lambda ensemble, gains: ensemble(layer_norm=True, running_count=100),
    "normed ones of missions": lambda ensemble, gains: grown_apart(
        ensemble(layer_norm=True).expand_(2)
    ),
    "an oracle": lambda ensemble, gains: told(Dubins(), gains),
    "an oracle of an ensemble": lambda ensemble, gains: told(ensemble(), gains),
    "oracles of missions": lambda ensemble, gains: told(Dubins(), gains, 2),
    "an oracle whose effects depend on the state": lambda *_: told(Dubins(), Slope()),
    "calibrated": lambda *_: calibrated(missions=2),
    "calibrated, without an offset": lambda *_: calibrated(missions=2, offset=0.0),
    "with residuals of missions": lambda *_: with_residual(Dubins(), missions=2),
    "any rate": lambda *_: KNODE(Dubins(), rate=car_rate, substeps=2, units=8).push_(),
}
ROBOTS = {
    "a quadrotor": lambda *_: Quadrotor(),
    "a quadrotor in three steps": lambda *_: Quadrotor(substeps=3),
    "oracles of quadrotors": lambda *_: told(Quadrotor(), flight_regimes(), 2),
    "a calibrated quadrotor": lambda *_: calibrated(Quadrotor().double(), missions=2),
    "networks": lambda *_: full(features=range(3, 13)),
    "networks in three steps": lambda *_: full(substeps=3, units=8, nominal={"dt": 0.1}),
    "networks of the body": lambda *_: full(frame="body"),
    "networks of missions": lambda *_: grown_apart(full().expand_(2)),
    "those in two steps": lambda *_: full(frame="body", features=range(3, 13), substeps=2),
}


def weakened(model):
    """Let a subclass override the prediction, and nothing else."""

    def forward(self, state, action):
        return kind.forward(self, state, 0.7 * action)

    kind = type(model)
    model.__class__ = type("Weak", (kind,), {"forward": forward})
    return model


@pytest.mark.parametrize(
    ("batch", "changed"),
    [((2, 3), lambda model: model), ((), weakened)],
    ids=["a batch", "alone and overridden"],
)
@pytest.mark.parametrize("name", CARS | ROBOTS)
def test_derivatives_are_those_of_the_prediction(
    name, batch, changed, make_ensemble, gains, transitions
):
    model = changed((CARS | ROBOTS)[name](make_ensemble, gains).double())
    batch = batch or tuple(model.lead)
    if name in CARS:
        state, action = transitions(*batch, dtype=torch.float64)
    else:
        state, action = flights(*batch)
        state = state + 0.01  # no unit quaternion: raw coordinates are free
    ahead = model(state, action)

    def slopes(of, argument):
        """Rows do not depend on each other: that of their sum is that of each."""
        reverse = torch.func.jacrev(
            lambda *x: of(*x).reshape(-1, of(*x).shape[-1]).sum(0), argument
        )
        return reverse(state, action).movedim(0, -2)

    expected = ahead, slopes(model, 0), slopes(model, 1)
    torch.testing.assert_close(model.linearise(state, action), expected)
    moved = slopes(lambda s, a: model.manifold.difference(model(s, a), s), 1)
    torch.testing.assert_close(model.jacobian(state, action), moved)
    plans = torch.stack([action, -action], -2).unsqueeze(-3)
    torch.testing.assert_close(
        model.rollout(state, plans), DynamicsModel.rollout(model, state, plans)
    )
    torch.testing.assert_close(model.forecast(state, action)[0], ahead)
