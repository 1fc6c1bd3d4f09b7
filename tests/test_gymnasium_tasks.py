"""The whole agent on environments that are not ours: `examples/gymnasium_tasks`."""

import importlib
import sys
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import torch
from torchrl.envs import GymEnv
from torchrl.envs.utils import check_env_specs

from afm_rl.transforms import RegimeTransform

FOLDER = Path(__file__).resolve().parents[1] / "examples" / "gymnasium_tasks"
MODULES = ("tasks", "agents", "run")
SMALL = {
    "rounds": (40, 20),
    "steps": 12,
    "hidden": (8, 8),
    "fit": {"epochs": 2},
    "planner": {"horizon": 3, "population": 8},
}


@pytest.fixture
def example(monkeypatch, tmp_path):
    """Import a module of the example; work in an empty folder, MuJoCo writes a log."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(FOLDER))
    yield importlib.import_module
    for name in MODULES:
        sys.modules.pop(name, None)


def observe(task, steps=40):
    """Return states, actions, next states and rewards of random actions."""
    if task.id != "Pendulum-v1":
        pytest.importorskip("mujoco")
    env = GymEnv(task.id)
    env.set_seed(0)
    data = env.rollout(steps, break_when_any_done=False)
    parts = data["observation"], data["action"].double(), data["next", "observation"]
    return parts, data["next", "reward"].squeeze(-1).to(parts[0])


@pytest.mark.parametrize("name", ["pendulum", "arm"])
def test_planners_are_told_the_true_reward(example, name):
    task = example("tasks").TASKS[name]
    parts, reward = observe(task)
    torch.testing.assert_close(task.reward(*parts).to(reward), reward, rtol=1e-3, atol=1e-4)


def test_running_is_rewarded_nearly_as_in_the_task(example):
    task = example("tasks").TASKS["half_cheetah"]
    parts, reward = observe(task)
    assert torch.corrcoef(torch.stack([task.reward(*parts), reward]))[0, 1] > 0.9
    state, action, upside_down = torch.zeros(17), torch.zeros(6), torch.zeros(17)
    upside_down[1] = torch.pi
    assert task.reward(state, action, upside_down) < task.reward(state, action, state) == 0.0


def test_balance_is_best_upright_in_the_middle(example):
    balance = example("tasks").balance
    states = torch.tensor([[0.0, 0.0], [0.0, 0.1], [0.3, 0.0]])
    reward = balance(states, torch.zeros(3, 1), states)
    assert reward[0] == 0.0 and (reward[1:] < 0).all()


@pytest.mark.parametrize("name", ["inverted_pendulum", "arm", "half_cheetah"])
def test_changes_sit_next_to_environments_in_double_precision(example, name):
    pytest.importorskip("mujoco")
    agents, task = example("agents"), example("tasks").TASKS[name]
    regime = agents.regimes_of(agents.make(task, 1))
    rows = torch.stack([regime.encode(change) for change in task.changes.values()])
    env = agents.make(task, len(rows), RegimeTransform(regime, rows.unsqueeze(1)))
    check_env_specs(env)
    data = env.rollout(2)
    assert data["observation"].dtype is torch.float32
    effect, command = data["next", "regime", "effective_action"][0, 0], data["action"][0, 0]
    gains = rows[0, : len(command)]
    torch.testing.assert_close(effect, gains * command)


@pytest.mark.parametrize("name", ["pendulum", "inverted_pendulum", "arm", "half_cheetah"])
def test_every_task_is_planned_by_its_own_planner(example, name):
    agents, task = example("agents"), example("tasks").TASKS[name]
    if name != "pendulum":
        pytest.importorskip("mujoco")
    env = agents.make(task, 1)
    size, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    model = agents.Ensemble(agents.Manifold(size), actions, range(size), hidden=[4])
    planner = agents.plan(task, model, env, seed=0)
    assert type(planner) is task.search
    assert planner.horizon == task.planner["horizon"]
    data = agents.make(task, 1, planner.make_tensordict_primer()).rollout(2, planner)
    assert data["action"].isfinite().all()


def test_every_method_runs_and_the_table_is_made_once(example, monkeypatch, capsys):
    name, run = "pendulum", example("run")
    tasks, agents = example("tasks").TASKS, example("agents")
    monkeypatch.setitem(tasks, name, replace(tasks[name], **SMALL))
    command = ["--task", name, "--out", "here"]
    run.main(command)
    table = capsys.readouterr().out.split("| change |")[1]
    assert all(f"| {method} |" in table for method in agents.METHODS)
    path = Path("here") / f"{name}_0.csv"
    found = pd.read_csv(path)
    assert len(found) == len(agents.METHODS) * len(tasks[name].changes)
    assert found[["before", "at", "after"]].notna().all(axis=None)
    before = found.pivot(index="change", columns="method", values="before")
    assert (before["frozen"] == before["oracle"]).all()  # the same until the change

    monkeypatch.delattr(run, "learn")  # what is there is not run again
    run.main(command)
    assert capsys.readouterr().out.split("| change |")[1] == table


def test_rewards_after_the_end_of_an_episode_do_not_count(example):
    run = example("run")
    done = torch.zeros(1, 80, 1, dtype=torch.bool)
    done[0, 29] = True
    data = {("next", "done"): done, ("next", "reward"): torch.ones(1, 80, 1)}
    found = run.spans(data, 80)
    assert found == {"before": 0.5, "at": 0.0, "after": 0.0}
    done[0, 29] = False
    assert run.spans(data, 80) == {"before": 1.0, "at": 1.0, "after": 1.0}
