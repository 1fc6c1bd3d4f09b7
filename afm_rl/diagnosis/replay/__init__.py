"""A log replayed: what would a correction have known of each command before it acted?"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.replay.table import AFM, SIMPLE, Replayed, errors_of, removed_by, slow_in

__all__ = ["Replayed", "replay"]


def replay(log: Log, seen: Callable[[float], object] = lambda share: None) -> Replayed:
    """Predict every row of a log from its command and the rows before, and compare.

    The robot's state is its response, and the model says that a response is its command. So the
    correction learns what commands do, as it would have on the robot, without acting; beside it
    stand the predictions of plain methods (:mod:`~afm_rl.diagnosis.replay.table`). Where an
    episode begins, or rows are missing, the command before is not known.

    Args:
        log: what a robot logged, or was commanded, in the same units.
        seen: is called with the share of the work that is done.

    >>> u = np.random.default_rng(0).uniform(-1, 1, (120, 1))
    >>> replay(Log(("pan",), u, -0.5 * u)).sentence
    'A correction would have removed 100 % of the error of pan.'
    """
    from afm_rl.diagnosis.replay.belief import BLANK, believe_log, watcher  # torch takes seconds

    steps = np.round(np.diff(log.seconds, prepend=log.seconds[0]) / log.step)
    missing = np.where(log.begins, BLANK, (steps - 1).clip(0, BLANK)).astype(int)
    predictions = {name: p(log.command, log.response, missing > 0) for name, p in SIMPLE.items()}
    corrector = watcher(len(log.names))
    predictions[AFM], std = believe_log(corrector, log.command, log.response, missing, seen)
    return Replayed(
        log,
        predictions,
        std,
        errors_of(log, predictions),
        removed_by(log, predictions),
        slow_in(log),
    )
