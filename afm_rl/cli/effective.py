"""A log of the actions that explain the states, through a step function."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from afm_rl.diagnosis import Log
from afm_rl.diagnosis.readers import TRANSITIONS, read_columns
from afm_rl.dynamics import KnownDynamics
from afm_rl.missions.explained import effective_log
from afm_rl.spaces.manifold import Manifold
from afm_rl.targets import find_code


def read_effective(path: Path, name: str) -> Log:
    """Return a log whose commands are the actions, and whose responses are effective actions.

    Args:
        path: a file with columns ``action.NAME`` and ``state.NAME``, or a folder of LeRobot's.
        name: of the step function, ``module.function``; the present folder is searched, too.

    Raises:
        ConfigurationError: if the file or the function cannot be used.
    """
    found = read_columns(path, TRANSITIONS)
    sys.path.insert(0, os.getcwd())
    try:
        step = find_code("--model", name)
    finally:
        sys.path.pop(0)
    model = KnownDynamics(step, Manifold(found.second.shape[1]), found.first.shape[1])
    names = tuple(found.names[0])
    return effective_log(model, names, found.second, found.first, found.t, found.episode)
