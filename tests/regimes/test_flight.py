"""Regimes of the quadrotor: each is exactly what happens to the body."""

from dataclasses import replace

import pytest
import torch
from harness import flights

from afm_rl.dynamics.quadrotor import quadrotor_rate
from afm_rl.regimes import (
    Compose,
    InertiaFactor,
    MassFactor,
    MotorEfficiency,
    Payload,
    Wind,
    flight_regimes,
    wind_of,
)
from afm_rl.spaces.airframe import QuadrotorBody, mix, unmix

BODY = QuadrotorBody()
LOW, HIGH = (torch.tensor(bound, dtype=torch.float64) for bound in BODY.bounds)


def actions(*batch):
    return LOW + (HIGH - LOW) * torch.rand(*batch, 4, dtype=torch.float64)


@pytest.mark.parametrize(
    ("family", "values", "body"),
    [
        (MassFactor(), {"mass": 0.5}, replace(BODY, mass=0.5 * BODY.mass)),
        (MassFactor(), {"mass": 1.5}, replace(BODY, mass=1.5 * BODY.mass)),
        (InertiaFactor(), {"inertia": 2.0}, replace(BODY, inertia=[2 * x for x in BODY.inertia])),
    ],
)
def test_another_body_is_exactly_another_action(family, values, body):
    state, action = flights(50)[0], actions(50)
    effective = family.apply(action, family.encode(values).double(), state)
    changed = quadrotor_rate(state, action, body)
    torch.testing.assert_close(quadrotor_rate(state, effective, BODY), changed)


def test_motors_lose_force_one_by_one():
    family, action = MotorEfficiency(), actions(50)
    row = torch.tensor([1.0, 0.5, 0.0, 0.8], dtype=torch.float64)
    effective = family.apply(action, row, flights(50)[0])
    torch.testing.assert_close(effective, mix(unmix(action, BODY) * row, BODY))
    # nothing can be had of a motor that stands still
    command = family.inverse(effective, row, flights(50)[0], LOW - 1, HIGH + 1)
    torch.testing.assert_close(family.apply(command, row, flights(50)[0]), effective)
    torch.testing.assert_close(unmix(command, BODY)[:, 2], torch.zeros(50).double())


def test_a_payload_in_hover_pulls_with_its_weight():
    family = Payload()
    row = family.encode({"payload": 1 / 3, "payload_x": 0.004, "payload_y": -0.002}).double()
    action = torch.tensor([BODY.hover_thrust * 4 / 3, 0, 0, 0], dtype=torch.float64)
    effective = family.apply(action, row, flights()[0])
    weight = torch.tensor([0, 0, -BODY.hover_thrust / 3], dtype=torch.float64)
    place = torch.tensor([0.004, -0.002, 0], dtype=torch.float64)
    moment = torch.linalg.cross(place, weight)
    torch.testing.assert_close(effective[1:], moment, rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(effective[0].item(), BODY.hover_thrust, rtol=1e-6, atol=0)


def test_the_wind_is_found_among_other_parameters():
    family = flight_regimes()
    row = family.encode({"wind_y": 1.5, "mass": 0.5})
    assert wind_of(family, row.expand(2, -1)).tolist() == [[0.0, 1.5, 0.0]] * 2
    assert wind_of(Compose([MassFactor(), Payload()]), torch.ones(4)) is None


def test_a_draw_changes_one_thing():
    family = flight_regimes()
    rows = family.sample((300,), torch.Generator().manual_seed(1))
    for name, part in (("mass", {"mass"}), ("wind", set(Wind.names))):
        columns = [i for i, known in enumerate(family.names) if known in part]
        others = [i for i, known in enumerate(family.names) if known not in part]
        nominal = torch.tensor(family.identity)
        changed = (rows[:, columns] != nominal[columns]).any(-1)
        assert 20 < changed.sum() < 120, name
        assert (rows[changed][:, others] == nominal[others]).all()
