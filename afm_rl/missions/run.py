"""Missions of one method, all in one batch."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import pandas as pd
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp
from tqdm.auto import tqdm

from afm_rl.missions.build import Agent
from afm_rl.missions.log import StepLog

SILENT = 5.0  # surprise, in standard deviations, up to which a model counts as aligned


@dataclass
class Results:
    """What a batch of missions gives."""

    missions: pd.DataFrame
    """One row per mission."""
    steps: pd.DataFrame
    """One row per mission and step."""


@torch.no_grad()
def run(agent: Agent, progress: bool = False) -> Results:
    """Run every mission of an agent to its end; missions that finish leave the batch.

    Each step: plan, transform and act, look at the model's error, update the model. The
    order is the same for one mission and for hundreds, and so are the results: to the bit, but
    for networks, whose batched products may round the last bit another way.

    Args:
        agent: from :func:`~afm_rl.missions.build.build`, prepared. Its model learns in place.
        progress: show a progress bar.
    """
    with torch.random.fork_rng(devices=[]):  # TorchRL's own planners draw from the global one
        torch.manual_seed(0)
        return _run(agent, progress)


def _run(agent: Agent, progress: bool) -> Results:
    env, planner, updater, model = agent.env, agent.planner, agent.updater, agent.model
    total = len(agent.missions)
    if updater.learns:
        model.expand_(total)
    td = env.reset(agent.missions, set_state=False)
    updater.start(td)
    ids = torch.arange(total)
    ends = {name: torch.zeros(total) for name in ("steps", "reached", "seconds")}
    log = StepLog(_columns(agent), whole=["misaligned", "regime_active", "reached"])
    clock, step = time.perf_counter(), 0
    with tqdm(
        total=total, desc=agent.label, unit="mission", disable=None if progress else True
    ) as bar:
        while len(ids):
            td = env.step(planner(td))
            error, surprise = _error(agent, td)
            loss = updater(td)["loss"]
            log.add(ids, step, _row(agent, td, error, surprise, loss))
            now = time.perf_counter()
            ends["seconds"][ids] += (now - clock) / len(ids)
            clock = now
            done = td["next", "done"].squeeze(-1)
            ends["steps"][ids] = step
            ends["reached"][ids] = td["next", "reached"].float()
            td = step_mdp(td)
            if bool(done.any()):
                keep = (~done).nonzero().squeeze(-1)
                bar.update(int(done.sum()))
                ids, td = ids[keep], td[keep]
                model.select_(keep)
            step += 1
            if progress and step % 50 == 0:
                bar.set_postfix(step=step, running=len(ids))
    return Results(_missions(agent, ends), log.table())


def _error(agent: Agent, td: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Return norm ``(B,)`` and surprise ``(B,)`` of the one-step prediction error."""
    state = td["observation"]
    expected, noise = agent.model.forecast(state, td.get(agent.executed_key))
    error = agent.model.manifold.difference(td["next", "observation"], expected)
    return error.norm(dim=-1), (error.abs() / noise).amax(-1)


def _columns(agent: Agent) -> list[str]:
    actions = agent.robot.action_names
    return [
        *agent.robot.state_names,
        *(f"goal_{name}" for name in agent.robot.goal_names),
        *(f"planned_{name}" for name in actions),
        *(f"executed_{name}" for name in actions),
        "error",
        "misaligned",
        "loss",
        "regime_active",
        "reached",
    ]


def _row(agent: Agent, td: TensorDictBase, error, surprise, loss) -> Tensor:
    """Return one step's values ``(B, C)``, in the order of :func:`_columns`."""
    transform = agent.transform
    flag = surprise > SILENT if transform is None else td["next", transform.key("misaligned")]
    scalars = [error, flag, loss, td["regime_active"], td["reached"]]
    parts = [td["observation"], td["goal"], td["action"], td.get(agent.executed_key)]
    return torch.cat([*parts, torch.stack([value.float() for value in scalars], -1)], -1)


def _missions(agent: Agent, ends: dict[str, Tensor]) -> pd.DataFrame:
    """Return the table of missions."""
    mission, base = agent.missions["mission"], agent.base_env
    reached = ends["reached"].int()
    targets = base.course.counts[mission["track"]].int()
    changed = _changed(agent, mission["parameters"])
    frame: dict[str, Any] = {
        "mission": range(len(reached)),
        "method": agent.label,
        "track": [base.tracks[int(index)].name for index in mission["track"]],
    }
    frame.update({name: changed[:, k] for k, name in enumerate(agent.robot.regime.names)})
    frame.update(
        seed=mission["seed"],
        success_rate=reached / targets,
        steps=ends["steps"].int(),
        reached=reached,
        targets=targets,
        finished=reached == targets,
        seconds=ends["seconds"],
    )
    return pd.DataFrame({name: _plain(value) for name, value in frame.items()})


def _changed(agent: Agent, parameters: Tensor) -> Tensor:
    """Return the first row ``(B, F)`` of each mission's phases that is not nominal."""
    changed = ~agent.robot.regime.is_identity(parameters)
    first = changed.int().argmax(-1)
    return parameters[torch.arange(len(parameters)), first]


def _plain(value):
    return value.numpy() if isinstance(value, Tensor) else value
