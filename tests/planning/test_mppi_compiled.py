"""MPPI as machine code plans the same."""

import pytest
import torch
from tensordict import TensorDict

from afm_rl.compiling import machine_code
from afm_rl.dynamics import Dubins
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv


def planner_of(box, cache, model=None, **settings):
    world = PlanningEnv(model or Dubins(), GoalDistance(), *box)
    return MPPI(world, 4, 16, iterations=2, temperature=0.1, cache=cache, **settings)


def plans(planner, batch):
    td = TensorDict({"observation": torch.zeros(*batch, 3), "goal": torch.ones(*batch, 2)}, batch)
    td["mppi", "mean"], found = torch.zeros(*batch, 4, 2), []
    for _ in range(3):
        td["mppi"] = planner(td)["next", "mppi"]
        found.append(td["action"])
    return torch.stack(found)


def test_what_is_compiled_plans_the_same_for_any_number_of_missions(box, tmp_path, traced):
    code = planner_of(box, tmp_path, compile=True)
    for batch in [(), (3,), (2, 2)]:
        code.streams.manual_seed(0)
        expected = plans(planner_of(box, tmp_path), batch)
        torch.testing.assert_close(plans(code, batch), expected, rtol=1e-4, atol=1e-5)
    assert traced == ["MPPI.improved"]


def test_without_a_compiler_it_plans_as_it_is(box, tmp_path, monkeypatch):
    monkeypatch.setattr(machine_code, "has_compiler", lambda: False)
    with pytest.warns(UserWarning, match="compile=true: goes on uncompiled: no C.. compiler"):
        found = plans(planner_of(box, tmp_path, compile=True), (2,))
    torch.testing.assert_close(found, plans(planner_of(box, tmp_path), (2,)))


def test_a_learned_model_is_not_compiled(box, tmp_path, make_ensemble):
    plans(planner_of(box, tmp_path, make_ensemble(), compile=True), (2,))
    assert not list(tmp_path.iterdir())
