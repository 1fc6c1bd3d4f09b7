"""Missions of one method, all in one batch."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp

from afm_rl.errors import AFMError, NonFiniteError
from afm_rl.imports import check_installed
from afm_rl.missions.build import Agent
from afm_rl.missions.curves import Curves
from afm_rl.missions.state import Loop, StepLog, leave, owner, restore, snapshot
from afm_rl.progress import Bar
from afm_rl.storage.artefacts import Checkpoints
from afm_rl.storage.measures import Measures

if TYPE_CHECKING:
    import pandas as pd

FIGURES = ("error", "miss", "unforeseen", "corrected", "loss", "regime_active", "fault")
"""What is logged of a step whatever the mission is."""

PROGRESS = "{elapsed} so far{postfix}"


class Stopped(AFMError):
    """Missions were told to stop before their end."""


@dataclass
class Results:
    """The results of a batch of missions."""

    missions: pd.DataFrame
    """One row per mission."""
    steps: pd.DataFrame
    """One row per mission and step."""
    measures: Measures
    """What the missions are compared by."""


@torch.no_grad()
def run(
    agent: Agent,
    progress: bool = False,
    checkpoint: Path | None = None,
    every: float = 60.0,
    keep: int = 2,
    stopped: Callable[[Loop], bool] | None = None,
    curves: Curves | None = None,
) -> Results:
    """Run every mission of an agent to its end; missions that finish leave the batch.

    Each step plans, corrects, acts, measures the error of the model and updates the model.
    The results are the same for one mission and for hundreds, bit for bit, except for networks,
    whose batched products may round the last bit differently.

    A fault is a reading that is missing, not finite or stale, or a plan that is not finite.
    Nothing is learned from it. The mission continues with its last safe action (``faults=hold``)
    or ends (``skip``), or the run ends with an error (``raise``).

    With a ``checkpoint`` folder a killed run resumes from its last checkpoint, with the same
    results bit for bit. The files are not deleted: delete them when the results are safe.

    Args:
        agent: from :func:`~afm_rl.missions.build.build`, prepared. Its model learns in place.
        progress: show progress.
        checkpoint: folder of checkpoints; if it holds any, the run continues from the latest.
        every: time between two checkpoints (s); 0 writes one after each step.
        keep: number of checkpoints to keep.
        stopped: called with the state after each step; true stops the run.
        curves: written while the missions run.

    Raises:
        ArtefactError: if the checkpoint is damaged, or was made by other missions; the agent
            does not change.
        ConfigurationError: for a time that cannot be used, or a file that cannot be written.
        NonFiniteError: at a fault, with ``faults=raise``.
        Stopped: if ``stopped`` returned true; a checkpoint was written.
    """
    check_installed("missions", "pandas")  # before the first step, not after the last one
    store = None if checkpoint is None else Checkpoints(checkpoint, owner(agent), every, keep)
    with torch.random.fork_rng(devices=[]):  # policies that explore draw from the global one
        torch.manual_seed(0)
        state = None if store is None else store.read()  # before the agent is changed
        loop = _start(agent)
        if state is not None:
            restore(agent, loop, state)
        total, clock, most = len(agent.missions), time.perf_counter(), most_steps(agent)
        look: Any = {"desc": agent.label, "shown": progress, "main": True}
        begun, done = time.perf_counter(), 0  # mission-steps in this process
        with Bar(total=total, initial=total - len(loop.ids), form=PROGRESS, **look) as bar:
            while len(loop.ids):
                ids = loop.ids
                figures = _advance(agent, loop)
                loop.ends["seconds"][ids] += (time.perf_counter() - clock) / len(ids)
                if curves is not None:
                    curves.add(agent, loop, figures)
                clock = time.perf_counter()
                done += len(ids)
                bar.set_postfix_str(_progress(loop, most, done, clock - begun), refresh=False)
                bar.update(total - len(loop.ids) - bar.n)
                stop = stopped is not None and stopped(loop)
                if store is not None and (stop or store.due):
                    store.write(loop.step, snapshot(agent, loop))
                if stop:
                    raise Stopped(f"stopped before step {loop.step}")
    measures = agent.robot.metrics.measures
    results = Results(_missions(agent, loop.ends), loop.log.table(), measures)
    if curves is not None:
        curves.end(agent, results.missions)
    return results


def most_steps(agent: Agent) -> int:
    """Return how many steps a mission takes at most."""
    budget = agent.settings["budget"]
    return min(budget, getattr(agent.base_env, "max_steps", budget))


def _progress(loop: Loop, most: int, done: int, seconds: float) -> str:
    """Say how many missions have ended, how fast they go and, if that shows it, the time left.

    Args:
        loop: the missions.
        most: steps that a mission takes at most.
        done: steps of all missions in these seconds.
        seconds: since the beginning.
    """
    running, total = len(loop.ids), len(loop.ends["steps"])
    text = f"{total - running} of {total} missions ended, {done / seconds:,.0f} steps/s"
    ended = torch.ones(total, dtype=torch.bool, device=loop.ids.device)
    ended[loop.ids] = False
    left = steps_left(loop.ends["steps"][ended], running, loop.step, most)
    if not left:
        return text
    return f"{text}, about {Bar.format_interval(running * left * seconds / done)} left"


def steps_left(ended: Tensor, running: int, now: int, most: int) -> float | None:
    """Return how many steps it takes until all missions, which run side by side, have ended.

    They are expected to end at the pace at which they have since the first one did.

    Args:
        ended: numbers of the last steps of those that have, ``(E,)``.
        running: number of those that have not.
        now: number of the next step.
        most: steps that a mission takes at most.

    Returns:
        None as long as fewer than two have ended: they show no pace.

    >>> steps_left(torch.tensor([90.0, 95.0, 99.0]), running=3, now=100, most=5000)
    15.0
    >>> steps_left(torch.tensor([90.0]), running=5, now=91, most=5000)
    """
    if len(ended) < 2:
        return None
    return min(running * (now - float(ended.min())) / (len(ended) - 1), float(most - now))


def _start(agent: Agent) -> Loop:
    """Return the state before the first step."""
    total = len(agent.missions)
    if agent.updater.learns:
        agent.model.expand_(total)
    td = agent.env.reset(agent.missions, set_state=False)
    agent.updater.start(td)
    ends = {name: torch.zeros(total) for name in ("steps", "seconds", "faults")}
    ends |= agent.robot.metrics.start(agent.missions)
    ends = {name: part.to(agent.device) for name, part in ends.items()}
    whole = ["corrected", "regime_active", "fault", *agent.robot.metrics.whole]
    log = StepLog(_columns(agent), whole)
    return Loop(td, torch.arange(total, device=agent.device), ends, log)


def _advance(agent: Agent, loop: Loop, still: float = 0.1) -> dict[str, Tensor]:
    """Take one step with every mission that runs, in place; return its figures ``(B,)``, by name.

    Args:
        agent: whose missions they are.
        loop: where they stand.
        still: innovation up to which a repeated reading shows a robot at rest, as foreseen.
    """
    td, ids = agent.env.step(agent.planner(loop.td)), loop.ids
    errors, innovation = _errors(agent, td)
    guard = td["next", "guard"]
    fault = guard["held"] | ~(guard["sound"] | (innovation < still))
    loss = agent.updater(td)["loss"]
    transform, score = agent.transform, agent.robot.metrics.row(td)
    corrected = torch.zeros_like(fault)
    if transform is not None:
        corrected = td["next", transform.key("corrected")]
    logged = (*errors, corrected, loss, td["regime_active"], fault)
    figures = dict(zip(FIGURES, logged, strict=True))
    loop.log.add(ids, loop.step, _row(agent, td, figures, score))
    if agent.faults == "raise" and bool(fault.any()):
        raise NonFiniteError(
            f"step {loop.step}: missions {ids[fault].tolist()}: a reading or a plan is missing, "
            "not finite or stale; faults=hold continues with the last safe action"
        )
    done = td["next", "done"].squeeze(-1)
    loop.ends["steps"][ids] = loop.step
    loop.ends["faults"][ids] += fault
    agent.robot.metrics.add(loop.ends, ids, td)
    loop.td = step_mdp(td)
    if agent.faults == "skip":
        done = done | fault
    if bool(done.any()):
        keep = (~done).nonzero().squeeze(-1)
        leave(agent, loop, keep)
    loop.step += 1
    # Curves show more than the table, and "corrected" only where something corrects.
    shown = {name: figure for name, figure in figures.items() if name != "corrected"}
    if transform is not None:
        noise = td["next", transform.key("noise")].mean(-1)
        shown |= {"corrected": corrected, "noise": noise}
    columns = dict(zip(agent.robot.metrics.columns, score.unbind(-1), strict=True))
    return {**shown, "innovation": innovation, **columns}


def _errors(agent: Agent, td: TensorDictBase) -> tuple[Sequence[Tensor], Tensor]:
    """Return the distances to three predictions, and the normalised innovation, ``(B,)`` each.

    The predictions are the model's for what was executed, for what was planned, and for the
    effect that the transform predicted; without a transform all are the first. The innovation is
    that of the first.
    """
    actions = [td.get(agent.executed_key)]
    if agent.transform is not None:
        actions += [td["action"], td["next", agent.transform.key("predicted_effect")]]
    state, reached = (part["observation"].unsqueeze(1) for part in (td, td["next"]))
    expected, noise = agent.model.forecast(
        state.expand(-1, len(actions), -1), torch.stack(actions, 1)
    )
    error = agent.model.manifold.difference(reached, expected)
    norms = list(error.norm(dim=-1).unbind(1))
    innovation = (error.abs() / noise)[:, 0].amax(-1)
    return norms if len(norms) > 1 else norms * 3, innovation


def _columns(agent: Agent) -> list[str]:
    actions = agent.robot.action_names
    return [
        *agent.robot.state_names,
        *(f"goal_{name}" for name in agent.robot.goal_names),
        *(f"planned_{name}" for name in actions),
        *(f"executed_{name}" for name in actions),
        *FIGURES,
        *agent.robot.metrics.columns,
    ]


def _row(agent: Agent, td: TensorDictBase, figures: Mapping[str, Tensor], score: Tensor) -> Tensor:
    """Return one step's values ``(B, C)``, in the order of :func:`_columns`."""
    goal, executed = agent.robot.metrics.goal(td), td.get(agent.executed_key)
    scalars = torch.stack([figures[name].float() for name in FIGURES], -1)
    return torch.cat([td["observation"], goal, td["action"], executed, scalars, score], -1)


def _missions(agent: Agent, ends: dict[str, Tensor]) -> pd.DataFrame:
    """Return the table of missions."""
    import pandas as pd

    mission, base = agent.missions["mission"], agent.base_env
    tracks = base.mission_format.tracks
    changed = _changed(agent, mission["parameters"])
    frame: dict[str, Any] = {
        "mission": range(len(agent.missions)),
        "method": agent.label,
        "track": [tracks[index] for index in mission["track"].tolist()],
    }
    frame.update({name: changed[:, k] for k, name in enumerate(agent.robot.regime.names)})
    frame.update(seed=mission["seed"])
    frame.update(agent.robot.metrics.table(base, agent.missions, ends))
    if agent.faults == "skip":
        whole = ends["faults"] == 0
        if "finished" in frame:
            frame["finished"] = frame["finished"] & whole
        else:
            frame["terminated"] = frame["terminated"] | ~whole
    frame.update(faults=ends["faults"].int(), seconds=ends["seconds"], regime=agent.regime_names)
    for name, value in frame.items():
        frame[name] = value.cpu().numpy() if isinstance(value, Tensor) else value
    return pd.DataFrame(frame)


def _changed(agent: Agent, parameters: Tensor) -> Tensor:
    """Return the first row ``(B, F)`` of each mission's phases that is not nominal."""
    changed = ~agent.robot.regime.is_identity(parameters)
    first = changed.int().argmax(-1)
    return parameters[torch.arange(len(parameters), device=first.device), first]
