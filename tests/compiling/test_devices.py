"""The device of tensors: what is not there is refused; copies in another precision."""

import copy

import pytest
import torch
from fake_gpu import DEVICE, FakeGPU
from torch import nn

from afm_rl.compiling.devices import CastCache, check_device, device_of
from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv

BOX = [-1.0, -1.5], [1.0, 1.5]


@pytest.fixture
def two_gpus(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)


def test_devices_that_are_there(two_gpus):
    assert check_device("device", "cuda") == torch.device("cuda:0")
    assert check_device("device", "cuda:1") == torch.device("cuda:1")


@pytest.mark.parametrize("given", ["cuda:2", "gpu", "meta", 3, None])
def test_others_are_refused_in_one_line_that_names_those_there(two_gpus, given):
    with pytest.raises(ConfigurationError, match="available: cpu, cuda:0, cuda:1") as caught:
        check_device("device", given)
    assert f"device={given!r}" in str(caught.value) and "\n" not in str(caught.value)


def test_a_planning_environment_leaves_the_model_where_it_is():
    model = Dubins()
    with FakeGPU() as gpu:
        gpu.move(model)
        env = PlanningEnv(model, GoalDistance(), *BOX)
        assert device_of(model) == DEVICE and env.full_action_spec.device == DEVICE


def test_the_specs_of_a_planner_move_with_it():
    planner = MPPI(PlanningEnv(Dubins(), GoalDistance(), *BOX), horizon=3, candidates=4).to("meta")
    assert planner.action_spec.device.type == "meta" and planner.env.device.type == "meta"
    assert planner.env.full_action_spec.device.type == "meta"


@pytest.fixture
def weights():
    """Two parameters that bfloat16 does not hold exactly."""
    return [nn.Parameter(torch.randn(4, 3)), nn.Parameter(torch.randn(4, 1, 2))]


def true_to(copies, weights):
    """Are the copies those of the present values?"""
    found = copies.of(weights)
    return all(
        torch.equal(one, weight.to(copies.dtype)) and not one.requires_grad
        for one, weight in zip(found, weights, strict=True)
    )


def replaced(weights):
    weights[0].data = weights[0].data.clone() + 1


def cut(weights):
    weights[0].data = weights[0].data[:2]  # at the same address


def turned(weights):
    weights[0].data = weights[0].data[:3].T  # the same shape and address in the end


def added(weights):
    with torch.no_grad():
        weights[1].add_(1.0)


def dropped(weights):
    weights.pop()


@pytest.mark.parametrize("change", [replaced, cut, turned, added, dropped])
def test_every_change_is_seen(weights, change):
    copies = CastCache(torch.bfloat16)
    weights[0].data = weights[0].data[:3]
    assert true_to(copies, weights)
    change(weights)
    assert true_to(copies, weights)


def test_nothing_is_cast_twice_and_memory_serves_again(weights):
    copies = CastCache(torch.bfloat16)
    first = list(copies.of(weights))
    versions = [one._version for one in first]
    assert all(a is b for a, b in zip(copies.of(weights), first, strict=True))
    assert [one._version for one in first] == versions
    added(weights)
    assert all(a is b for a, b in zip(copies.of(weights), first, strict=True))
    assert all(one._version > version for one, version in zip(first, versions, strict=True))


def test_a_copied_model_has_copies_of_its_own(weights):
    copies = CastCache(torch.float64)
    first = copies.of(weights)
    twin = copy.deepcopy(copies)
    assert twin.dtype is torch.float64 and twin.of(weights)[0] is not first[0]
