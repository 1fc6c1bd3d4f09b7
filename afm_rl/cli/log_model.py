"""A log of states and actions, through a model that a user names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from afm_rl.diagnosis import Log
from afm_rl.diagnosis.model_check import ModelCheck, check_transitions
from afm_rl.diagnosis.pairs import effective_log
from afm_rl.diagnosis.readers import Columns
from afm_rl.diagnosis.readers.source import blocks_of, rows_of, thinned_note
from afm_rl.dynamics import DynamicsModel, KnownDynamics, MuJoCoDynamics
from afm_rl.dynamics.mujoco_model import check_files, read_model
from afm_rl.errors import ConfigurationError, printable
from afm_rl.spaces.manifold import Manifold
from afm_rl.trust import find_code, name_of, trusted, trusted_folders, trusting


def model_of(name: str, trust: Sequence[str], columns: Columns) -> DynamicsModel:
    """Return the model of the robot that logged some columns.

    Args:
        name: of an MJCF file, which makes as many steps in a row as the times of the log say; or
            ``PACKAGE.FUNCTION``, a step function or a model.
        trust: packages whose code may be called, and folders whose files an MJCF may read.
        columns: actions and states.

    Raises:
        ConfigurationError: for a package or a file that is not trusted, or if there is no such
            model.
    """
    if Path(name).suffix.lower() in (".xml", ".mjcf"):
        with trusting(trust):
            check_files("--model", name, trusted_folders())
        mjcf, _ = read_model(name)
        model = MuJoCoDynamics(mjcf)
        if np.array_equal(columns.t, columns.row):  # no time was logged
            return model
        step = np.median(np.diff(columns.t)[np.diff(columns.episode) == 0])
        return MuJoCoDynamics(mjcf, frame_skip=max(1, round(float(step) / model.dt)))
    with trusting(trust):
        packages = ["afm_rl.dynamics", *map(name_of, trusted())]
        if not any(name.startswith(f"{package}.") for package in packages):
            raise ConfigurationError(
                f"--model {printable(name)}: expected a file .xml, or a function of a package that "
                f"you trust: --trust {printable(name.partition('.')[0])}"
            )
        found = find_code("--model", name)
    if isinstance(found, DynamicsModel):
        return found
    return KnownDynamics(found, Manifold(columns.second.shape[1]), columns.first.shape[1])


def columns_of(model: DynamicsModel, columns: Columns, most: int = 4000) -> Columns:
    """Return the columns of a log that a model names, in its order; all, if it names none.

    Of a simulator, of which every step takes its time, ``most`` rows, in blocks.

    Raises:
        ConfigurationError: naming columns that are missing.
    """
    states, actions = getattr(model, "names", columns.names[::-1])
    action = _chosen("action", actions, columns.names[0], columns.first)
    state = _chosen("state", states, columns.names[1], columns.second)
    rows = rows_of(blocks_of(len(state), most=most if model.stiff else len(state)))
    apart = (np.diff(columns.episode[rows]) != 0) | (np.diff(rows) > 1)
    return replace(
        columns,
        names=([printable(x) for x in actions], [printable(x) for x in states]),
        first=action[rows],
        second=state[rows],
        t=columns.t[rows],
        episode=np.append(0, np.cumsum(apart)),
        row=columns.row[rows],
        notes=thinned_note(rows, len(columns.t)),
    )


def check_columns(model: DynamicsModel, columns: Columns) -> ModelCheck:
    """Return how far a model is right about the steps of a log."""
    rows = _followed(columns)
    state, action, after = columns.second[rows], columns.first[rows], columns.second[rows + 1]
    return check_transitions(model, state, action, after, columns.names[1], columns.names[0])


def through_model(model: DynamicsModel, columns: Columns) -> Log:
    """Return a log whose responses are effective actions."""
    rows = _followed(columns)
    state, action, after = columns.second[rows], columns.first[rows], columns.second[rows + 1]
    t, episode = columns.t[rows], columns.episode[rows]
    log = effective_log(model, columns.names[0], state, action, after, t, episode)
    return replace(log, notes=(*log.notes, *columns.notes))


def _followed(columns: Columns) -> np.ndarray:
    """Return the numbers of the rows that have a next one."""
    return np.flatnonzero(np.diff(columns.episode) == 0)


def _chosen(
    kind: str, wanted: Sequence[str], names: Sequence[str], values: np.ndarray
) -> np.ndarray:
    """Return the columns that are wanted, in that order."""
    missing = [name for name in wanted if name not in names]
    if missing:
        option = {"action": "--command", "state": "--response"}[kind]
        raise ConfigurationError(
            f"no column {printable(', '.join(f'{kind}.{name}' for name in missing), 300)} for the "
            f"model, but {printable(', '.join(f'{kind}.{name}' for name in names), 300)}; rename "
            f"them, or name the columns: {option} {missing[0]}=COLUMN,..."
        )
    return values[:, [names.index(name) for name in wanted]]
