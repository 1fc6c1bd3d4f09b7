"""Readings: which remembered pairs tell what an action does now.

The newest pairs tell it, unless commands act late, the ground changes from place to place, or the
newest commands were all alike. Each reading is a model of the belief, by what the network answers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.correction.experts import Rows
from afm_rl.correction.linear import CALM
from afm_rl.errors import ConfigurationError, check_choice

FILTER = 12  # commands that a lag looks back on
AGE = 20.0  # steps that separate two pairs as much as one unit of place does
FAR = 1e3  # squared distance beyond all
OLDER = 1e-6  # squared distance that a pair is worth less, times its squared age


class Reading(NamedTuple):
    """One way of reading the memory."""

    share: float = 0.5
    """Part of the K rows that is filled."""
    delay: int = 0
    """Steps from a command to its effect."""
    lag: float = 0.0
    """Time constant with which effects follow commands, in steps."""
    near: bool = False
    """Whether it reads the pairs nearest in place instead of in time."""
    varied: bool = False
    """Whether it reads pairs whose commands differ as much as possible."""


READINGS = {
    "recent": Reading(),
    "newest": Reading(share=1 / 6),  # right after a change
    "long": Reading(share=1.0),
    "varied": Reading(share=1.0, varied=True),  # also when it was at rest of late
    **{f"delay_{k}": Reading(delay=k) for k in range(1, 9)},
    **{f"lag_{k}": Reading(lag=k) for k in range(1, 4)},
    "near": Reading(near=True),
    "nearest": Reading(share=1 / 6, near=True),
    "here": Reading(share=1 / 12, near=True),  # at the edge of two grounds
}


class Layout(NamedTuple):
    """How H readings fill K rows, in the order of :func:`check_readings`.

    Ages count from the newest pair, 0.
    """

    command: Tensor
    """What the commands of the readings by time weigh, by age, the oldest first, ``(T K, L)``."""
    effect: Tensor
    """Ages of their effects, ``(T K,)``."""
    filled: Tensor
    """Which rows are filled, ``(H, K, 1)``, 0 or 1."""
    acting: Tensor
    """What commands weigh in what acts now, by age, the oldest first, ``(H, L)``."""


def lay_out(readings: Sequence[Reading], rows: int) -> Layout:
    """Return the layout of K ``rows``.

    >>> lay_out([Reading(share=1.0, delay=1)], rows=2).command
    tensor([[1., 0., 0.],
            [0., 1., 0.]])
    """
    age = torch.arange(rows - 1, -1, -1)
    timed = [h for h in readings if not (h.near or h.varied)]
    length = memory_of(readings, rows)
    acting = torch.stack([_weights(h, length) for h in readings])
    command = torch.stack([w.roll(-int(k)) for w in acting[: len(timed)] for k in age])
    count = torch.tensor([max(1, round(h.share * rows)) for h in readings])
    filled = (age < count.unsqueeze(-1)).unsqueeze(-1).float()
    return Layout(command, age.repeat(len(timed)), filled, acting)


def _weights(reading: Reading, length: int) -> Tensor:
    """Return what the newest commands weigh in what acts now, the oldest first, ``(length,)``."""
    newest = torch.zeros(length)
    count, keep = (FILTER, math.exp(-1 / reading.lag)) if reading.lag else (1, 0.0)
    for k in range(count):
        share = 1.0 if k == count - 1 else 1 - keep  # the oldest stands for those before it
        newest[reading.delay + k] = share * keep**k
    return newest.flip(0)


def memory_of(readings: Sequence[Reading], rows: int) -> int:
    """Return how many pairs the readings of K ``rows`` read at most."""
    return rows + max(h.delay + (FILTER - 1 if h.lag else 0) for h in readings)


def late_ones(names: Sequence[str]) -> list[str]:
    """Return the readings by which actions act late, or slowly.

    >>> late_ones(["recent", "delay_2", "lag_1"])
    ['delay_2', 'lag_1']
    """
    return [name for name in names if READINGS[name].delay or READINGS[name].lag]


def cause_of(model: str, known: int = 0) -> str:
    """Return what a model of the belief says of the actuators, in plain words.

    Args:
        model: name of one.
        known: steps that actions are known to be late by.

    >>> [cause_of(model) for model in ("delay_2", "only lag_1", "gain_12")]
    ['2 steps late', 'slow', 'a recent change']
    """
    reading = READINGS.get(model.removeprefix("only "), Reading())
    if reading.delay:
        steps = reading.delay + known
        return f"{steps} step{'s' * (steps > 1)} late"
    if reading.lag:
        return "slow"
    if reading.near:
        return "another ground"
    return model if model in ("nothing has changed", *CALM) else "a recent change"


def check_readings(names: Sequence[str], by_place: bool) -> list[str]:
    """Return the names in the order of :func:`read_rows`: by time, by variety, by place.

    Those by place are dropped without a place.

    Raises:
        ConfigurationError: if it is no list of readings, or none by time is left.

    >>> check_readings(["near", "recent"], by_place=True)
    ['recent', 'near']
    """
    if isinstance(names, str) or not isinstance(names, Sequence) or not names:
        raise ConfigurationError(
            f"corrector.readings={names!r}: expected a list of {', '.join(READINGS)}"
        )
    for name in names:
        check_choice("corrector.readings", name, READINGS)
    near = [name for name in names if READINGS[name].near]
    varied = [name for name in names if READINGS[name].varied]
    timed = [name for name in names if name not in near + varied]
    if not timed:
        raise ConfigurationError(
            f"corrector.readings={list(names)!r}: expected one by time, such as recent"
        )
    return timed + varied + (near if by_place else [])


def read_rows(
    pairs: Tensor,
    layout: Layout,
    size: int,
    away: Tensor | None,
    varied: int = 0,
    follow: Tensor | None = None,
) -> Rows:
    """Return the rows of each reading, ``(*B, H, K, A)``.

    Args:
        pairs: the memory, oldest first: executed, effective, standard deviation, valid, and what
            else there is, ``(*B, M, D)``.
        layout: of the readings.
        size: number of actions, A.
        away: squared distance in place of each pair from here, ``(*B, M)``; None without
            readings by place.
        varied: number of readings by variety.
        follow: the pairs that readings by variety and place read, if they are others: those of
            commands with their late effects.

    >>> u = torch.tensor([[0.1], [0.2], [0.3]])
    >>> pairs = torch.cat([u, 10 * u, 0 * u, torch.ones(3, 1)], -1)
    >>> late = lay_out([Reading(share=1.0, delay=1)], rows=2)
    >>> rows = read_rows(pairs, late, 1, None)
    >>> rows.executed.flatten(), rows.effective.flatten()
    (tensor([0.1000, 0.2000]), tensor([2., 3.]))
    """
    newest, rows = pairs.shape[-2] - 1, layout.filled.shape[-2]
    effects = pairs.index_select(-2, newest - layout.effect)
    commands = pairs[..., -layout.command.shape[-1] :, :]
    lost = (commands[..., 3 * size : 3 * size + 1] == 0).to(commands)
    sent = torch.cat([commands[..., :size], lost], -1)
    executed, lost = (layout.command.to(sent) @ sent).split([size, 1], -1)
    valid = (lost == 0).to(sent)
    effective, std, came = effects[..., size : 3 * size + 1].split([size, size, 1], -1)
    came = (came == 1.0).to(came)  # what was sound before a change tells nothing about it
    parts = [part.unflatten(-2, (-1, rows)) for part in (executed, effective, std, valid * came)]
    by_time = parts[0].shape[-3]
    pairs = pairs if follow is None else follow
    found = [(_varied(pairs, size, rows), varied)] if varied else []
    if away is not None:
        found.append((_nearest(pairs, away, rows), len(layout.filled) - by_time - varied))
    for read, count in found:
        shape = (*read.shape[:-2], count, *read.shape[-2:])
        sizes = [size, size, size, 1, read.shape[-1] - 3 * size - 1]
        more = read.unsqueeze(-3).expand(shape).split(sizes, -1)
        more = (*more[:3], (more[3] > 0).to(pairs))
        parts = [torch.cat([part, new], -3) for part, new in zip(parts, more, strict=False)]
    filled = parts[3] * layout.filled
    executed, effective, std = (part * filled for part in parts[:3])
    return Rows(executed, effective, std, filled)


def _nearest(pairs: Tensor, away: Tensor, rows: int) -> Tensor:
    """Return the K pairs ``(*B, K, D)`` nearest to here, the nearest last."""
    age = torch.arange(away.shape[-1] - 1, -1, -1, device=away.device) / AGE
    nearest = (away + age.square()).topk(rows, -1, largest=False).indices.flip(-1)
    return pairs.gather(-2, nearest.unsqueeze(-1).expand(*nearest.shape, pairs.shape[-1]))


def _varied(pairs: Tensor, size: int, rows: int) -> Tensor:
    """Return the pairs whose commands are farthest from all that came after them.

    Of the pairs since the last change, ``(*B, K, D)``, oldest first; the newest is always among
    them. Where there are fewer, rows are not valid.
    """
    sent, sound = pairs[..., :size], pairs[..., 3 * size] == 1.0
    apart = (sent.unsqueeze(-2) - sent.unsqueeze(-3)).square().sum(-1)
    age = torch.arange(pairs.shape[-2] - 1, -1, -1, device=pairs.device)
    later = (age < age.unsqueeze(-1)) & sound.unsqueeze(-2)
    new = torch.where(later, apart, FAR).amin(-1) - OLDER * age.square()
    worth, chosen = torch.where(sound, new, -torch.inf).topk(rows, -1)
    chosen, order = chosen.sort(-1)
    row = chosen.unsqueeze(-1).expand(*chosen.shape, pairs.shape[-1])
    found = worth.gather(-1, order) > -torch.inf
    return pairs.gather(-2, row) * found.unsqueeze(-1)
