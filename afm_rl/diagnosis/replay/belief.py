"""What action flow matching believes that each command of a log will do."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from afm_rl.correction import ActionFlow
from afm_rl.dynamics import KnownDynamics
from afm_rl.spaces.manifold import Manifold

BLANK = 8  # the longest delay that the correction knows, in rows


def watcher(size: int) -> ActionFlow:
    """Return the correction as it comes, for actions in [-1, 1]."""
    return ActionFlow(-torch.ones(size), torch.ones(size))


def identity(size: int) -> KnownDynamics:
    """Return the model of a healthy robot whose state is its response: the last command.

    A further coordinate turns from 0 to 1 and back at each row. It tells a response that is the
    same again from a reading that is repeated: what a log holds between two messages counts.

    >>> identity(2)(torch.zeros(3), torch.tensor([0.1, 0.2]))
    tensor([0.1000, 0.2000, 1.0000])
    """

    def step(state: Tensor, action: Tensor) -> Tensor:
        return torch.cat([action, 1 - state[..., -1:].expand_as(action[..., -1:])], -1)

    return KnownDynamics(step, Manifold(size + 1), size, affine=True)


@torch.no_grad()
def believe(
    corrector: ActionFlow,
    command: np.ndarray,
    response: np.ndarray,
    seen: Callable[[int], object] = lambda row: None,
) -> np.ndarray:
    """Return what each command was predicted to do, and the standard deviation, ``(2, T, *B, A)``.

    A row is predicted from its command and from earlier rows. The corrector never acts.

    Args:
        corrector: made for actions in [-1, 1].
        command: rows of logs side by side, in units of the largest command, ``(T, *B, A)``.
        response: in the same unit, NaN where nothing was measured, ``(T, *B, A)``.
        seen: is called after each row, with its number.
    """
    sent, felt = (torch.as_tensor(part, dtype=torch.float32) for part in (command, response))
    model = identity(sent.shape[-1])
    turn = (torch.arange(1.0, len(felt) + 1) % 2).view(-1, *[1] * (felt.dim() - 1))
    felt = torch.cat([felt, turn.expand(*felt.shape[:-1], 1)], -1)
    memory, forecasts = corrector.begin(torch.zeros_like(felt[0])), []
    for row, (action, state) in enumerate(zip(sent, felt, strict=True)):
        memory = corrector.follow(memory, action, model)
        forecasts.append(torch.stack(corrector.expected_in(memory)))
        memory = corrector.observe(memory, state)
        seen(row)
    return torch.stack(forecasts, 1).numpy().astype(float)


def believe_log(
    corrector: ActionFlow,
    command: np.ndarray,
    response: np.ndarray,
    missing: np.ndarray,
    seen: Callable[[float], object] = lambda share: None,
    length: int = 1024,
    warm: int = 256,
    grown: float = 1.5,
    blank: int = BLANK,
) -> np.ndarray:
    """Return prediction and standard deviation of each row of a log, ``(2, N, A)``.

    Blocks of rows are replayed side by side. Each begins a while earlier, with the rows from which
    the belief is learnt; it forgets older ones within some forty rows. Its unit is the largest
    command up to its first row, and where commands outgrow that, another block begins: so no row
    knows anything of a later one, and the same rows of a longer log are predicted alike.

    Args:
        corrector: made for actions in [-1, 1].
        command: ``(N, A)``.
        response: ``(N, A)``.
        missing: rows between each row and the one before of which nothing is known, ``(N,)``.
        seen: is called with the share of the work that is done.
        length: rows of a block.
        warm: rows from which a block learns before it predicts.
        grown: factor by which commands outgrow a unit.
        blank: the most that are replayed of missing rows: as many as the longest delay, so that no
            effect is laid to a command before them.
    """
    order = _with_blanks(missing.clip(0, blank))
    rows = np.maximum.accumulate(order)  # of a blank, the row before
    unit = _units(command, response)[rows]
    starts = _starts(unit, length, grown)
    ends = np.append(starts[1:], len(order))
    first = np.maximum(starts - warm, 0)
    place = first + np.arange((ends - first).max())[:, None]  # (T, B)
    place = np.where(place < ends, place, -1)
    row = np.where(place >= 0, order[place], -1)
    scale = unit[starts]  # (B, A)
    sent = np.where(row[..., None] >= 0, command[row] / scale, 0.0)
    felt = np.where(row[..., None] >= 0, response[row] / scale, np.nan)
    steps = len(row)
    forecast = scale * believe(corrector, sent, felt, lambda step: seen((step + 1) / steps))
    mean_and_std = np.empty((2, *command.shape))
    own = (place >= starts) & (row >= 0)
    mean_and_std[:, row[own]] = forecast[:, own]
    return mean_and_std


def _with_blanks(missing: np.ndarray) -> np.ndarray:
    """Return the numbers of rows in order, with -1 for missing ones, but none at the begin.

    >>> _with_blanks(np.array([2, 0, 2]))
    array([ 0,  1, -1, -1,  2])
    """
    rows = np.arange(len(missing))
    return np.insert(rows, np.repeat(rows[1:], missing[1:]), -1)


def _units(command: np.ndarray, response: np.ndarray) -> np.ndarray:
    """Return the largest command up to each row, or the largest response before the first one."""
    largest, felt = (np.maximum.accumulate(np.abs(part)) for part in (command, response))
    before = np.vstack([np.zeros((1, felt.shape[1])), felt[:-1]])
    unit = np.where(largest > 0, largest, before)
    return np.where(unit > 0, unit, 1.0)


def _starts(unit: np.ndarray, length: int, grown: float) -> np.ndarray:
    """Return where blocks begin: every ``length`` rows, and where a unit has grown.

    >>> _starts(np.array([[1.0], [1.0], [2.0], [2.0], [2.0]]), length=2, grown=1.5)
    array([0, 2, 4])
    """
    starts = [0]
    while True:
        start = starts[-1]
        ahead = unit[start : start + length]
        other = (ahead > grown * ahead[0]) | (ahead < ahead[0] / grown)
        outgrown = np.flatnonzero(other.any(1))
        start += int(outgrown[0]) if len(outgrown) else length
        if start >= len(unit):
            return np.array(starts)
        starts.append(start)
