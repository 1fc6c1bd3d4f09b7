"""Frames in which a robot may tell its state, where its model knows others."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
import roma
import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel


def other_frames(
    model: DynamicsModel, names: Sequence[str]
) -> Iterator[tuple[str, Callable[[Tensor], Tensor]]]:
    """Yield in which frames a robot may tell its state, and the function to those of the model.

    >>> from afm_rl.dynamics import Dubins
    >>> (cause, read), *_ = other_frames(Dubins(), ("x", "y", "heading"))
    >>> cause, read(torch.tensor([1.0, 2.0, 0.5])).tolist()
    ('has x mirrored (the sign of an axis)', [-1.0, 2.0, 0.5])
    """
    turns = getattr(model.manifold, "quaternions", ())
    for first in turns:
        entries = list(range(model.state_size))
        entries[first : first + 4] = first + 3, first, first + 1, first + 2
        cause = "has its quaternion as x, y, z, w, the model as w, x, y, z"
        yield cause, partial(torch.index_select, dim=-1, index=torch.tensor(entries))
    for turn, speed in _free_joints(model):
        cause = "has its rates of turning in the world's frame, the model in the body's"
        yield cause, partial(_rotated, turn=turn, at=speed + 3, back=True)
        cause = "has its velocity in the body's frame, the model in the world's"
        yield cause, partial(_rotated, turn=turn, at=speed, back=False)
    if turns:
        return
    for chosen, which in subsets(names, (1, 2) if len(names) <= 12 else (1,)):
        cause = f"has {chosen} mirrored (the sign of an axis)"
        yield cause, partial(torch.mul, 1.0 - 2.0 * which)


def subsets(names: Sequence[str], sizes: Iterable[int]) -> Iterator[tuple[str, Tensor]]:
    """Yield the subsets of entries that have some sizes, in words, and which these are, ``(N,)``.

    >>> next(subsets(["x", "y", "z"], [2]))
    ('x, y', tensor([ True,  True, False]))
    """
    for chosen in (c for size in sizes for c in combinations(range(len(names)), size)):
        which = torch.zeros(len(names), dtype=torch.bool)
        which[list(chosen)] = True
        yield some_of([names[k] for k in chosen]), which


def some_of(texts: Sequence[str], most: int = 4) -> str:
    """Return the first of some texts.

    >>> some_of(["a", "b", "c"], 2)
    'a, b, ...'
    """
    return ", ".join([*texts[:most], *["..."][: len(texts) > most]])


def _free_joints(model: DynamicsModel) -> list[tuple[int, int]]:
    """Return where in a state quaternion and speeds of each body that moves freely begin."""
    mjcf: Any = getattr(model, "mjcf", None)
    free: Any = [] if mjcf is None else np.flatnonzero(mjcf.jnt_type == 0)
    return [(int(mjcf.jnt_qposadr[k]) + 3, mjcf.nq + int(mjcf.jnt_dofadr[k])) for k in free]


def _rotated(state: Tensor, turn: int, at: int, back: bool) -> Tensor:
    """Return states ``(N, S)`` with three numbers turned by the quaternion, or back."""
    turned, quaternion = state.clone(), state[:, turn : turn + 4].roll(-1, -1)
    quaternion = roma.quat_conjugation(quaternion) if back else quaternion
    turned[:, at : at + 3] = roma.quat_action(quaternion, state[:, at : at + 3])
    return turned
