"""The setting `device`: what is not there is refused, what is stored fits any device."""

import pytest
import torch
from fake_gpu import DEVICE, FakeGPU

from afm_rl.compiling.devices import check_device, device_of
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
    with pytest.raises(ConfigurationError, match="here is cpu, cuda:0, cuda:1") as caught:
        check_device("device", given)
    assert f"device={given!r}" in str(caught.value) and "\n" not in str(caught.value)


def test_a_planning_environment_leaves_the_model_where_it_is():
    model = Dubins()
    with FakeGPU() as gpu:
        gpu.move(model)
        env = PlanningEnv(model, GoalDistance(), *BOX)
        assert device_of(model) == DEVICE and env.full_action_spec.device == DEVICE


def test_the_specs_of_a_planner_move_with_it():
    planner = MPPI(PlanningEnv(Dubins(), GoalDistance(), *BOX), horizon=3, population=4).to("meta")
    assert planner.action_spec.device.type == "meta" and planner.env.device.type == "meta"
    assert planner.env.full_action_spec.device.type == "meta"
