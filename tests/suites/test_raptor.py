"""RAPTOR, a published policy in the place of a planner."""

import sys

import numpy as np
import pytest
import roma
import torch
from flight import Raptor
from tensordict import TensorDict

from afm_rl.dynamics import Quadrotor
from afm_rl.errors import ConfigurationError
from afm_rl.planning import GoalDistance, PlanningEnv
from afm_rl.spaces.airframe import QuadrotorBody, unmix

pytest.importorskip("foundation_policy")

BODY = QuadrotorBody(arm=0.043, k_d=7.8e-10, motors=(45.0, -45.0, -135.0, 135.0))


def planner(body=BODY):
    return Raptor(PlanningEnv(Quadrotor(body), GoalDistance(), *body.bounds), body)


def test_it_is_the_controller_of_rotorpy():
    """For two flights at once, of which RotorPy's controller flies each alone."""
    pytest.importorskip("rotorpy")
    from rotorpy.controllers.raptor import RaptorFoundationPolicy

    mine, draws = planner(), torch.Generator().manual_seed(0)
    limits = {"rotor_speed_min": 0.0, "rotor_speed_max": BODY.rotor_speed}
    theirs = [RaptorFoundationPolicy(limits) for _ in range(2)]
    kept = {("raptor", "hidden"): torch.zeros(2, 16), ("raptor", "last"): torch.zeros(2, 4)}
    for _ in range(5):
        state = 0.2 * torch.randn(2, 13, generator=draws)
        upright = torch.tensor([0.0, 0.0, 0.0, 1.0])
        state[:, 6:10] = roma.quat_normalize(state[:, 6:10] + upright)
        reference = torch.randn(2, 2, 6, generator=draws)
        td = TensorDict({"observation": state, "reference": reference, **kept}, [2])
        mine(td)
        kept = {key: td["next", *key] for key in kept}
        found = unmix(td["action"], BODY)
        for row, controller in enumerate(theirs):
            names = {"x": slice(0, 3), "v": slice(3, 6), "q": slice(6, 10), "w": slice(10, 13)}
            given = {name: state[row, at].double().numpy() for name, at in names.items()}
            wanted = reference[row, 0].double().numpy()
            flat = {"x": wanted[:3], "x_dot": wanted[3:]}
            # RotorPy gives one row, and the policy takes rows of a batch.
            inner = controller.policy.evaluate_step
            controller.policy.evaluate_step = lambda o, inner=inner: inner(np.atleast_2d(o))
            asked = controller.update(0.0, given, flat)["cmd_motor_speeds"]
            controller.policy.evaluate_step = inner
            np.testing.assert_allclose(found[row].numpy(), BODY.k_t * asked**2, atol=1e-6)


def test_it_needs_motors_where_it_has_them():
    with pytest.raises(ConfigurationError, match=r"expected \[-45.0, -135.0, 135.0, 45.0\]"):
        planner(QuadrotorBody())


def test_it_says_what_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "foundation_policy", None)
    with pytest.raises(ConfigurationError, match=r"pip install foundation-policy"):
        planner()
