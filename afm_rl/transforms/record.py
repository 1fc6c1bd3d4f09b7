"""What a correction was asked, what it did, and what was measured, as a log on disk."""

from __future__ import annotations

import csv
import errno
import io
import os
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from afm_rl.dynamics.inverse import effective_action
from afm_rl.errors import ConfigurationError, refusing, warn

KINDS = ("planned_action", "executed_action", "effective_action")


class Recorder:
    """Appends a line for each step of each mission to a CSV file, which ``afm-rl-diagnose`` reads.

    Its columns are ``episode_index``; ``t`` (s), if the model knows its step;
    ``planned_action.NAME``; ``executed_action.NAME``; ``effective_action.NAME``, empty where the
    step does not show it; and ``state.NAME``, the state before. Each line is handed to the system
    as a whole, so that the file can be read after a kill.

    Args:
        file: a new one, ``.csv``.

    Raises:
        ConfigurationError: if the file is there already, or cannot be written.
    """

    def __init__(self, file: str | Path) -> None:
        self.file = Path(file)
        if self.file.suffix != ".csv":
            raise ConfigurationError(f"record={str(file)!r}: expected a file .csv")
        if self.file.exists():
            raise ConfigurationError(
                f"record={str(file)!r}: is there already; expected a new file: name another, or "
                "move it"
            )
        self._handle: Any = None
        self._ended = False  # nothing more is written
        self._writer = 0  # number of the process
        self._acted: Any = None  # state, planned and executed action of the newest step
        self._next: Tensor | None = None  # the states that these led to
        self._episode = np.zeros(0, dtype=int)
        self._steps = np.zeros(0, dtype=int)

    def __deepcopy__(self, memo: dict[int, Any]) -> Recorder:
        """Return a recorder that writes nothing: two would write one file."""
        warn(f"record={str(self.file)!r}: a copy does not record; set record of the copy")
        copied = copy(self)
        copied._handle, copied._ended = None, True
        return copied

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_handle": None}

    def acted(self, state: Tensor, planned: Tensor, executed: Tensor) -> None:
        """Note what was planned and executed ``(*B, A)`` in a state ``(*B, S)``."""
        self._acted = state, planned, executed

    def observed(self, model: Any, scale: Tensor, state: Tensor) -> None:
        """Write what the actions led to, a state ``(*B, S)`` of a model.

        Args:
            model: by which effects are understood.
            scale: largest action of each axis, ``(A,)``.
            state: the measured one.
        """
        if self._ended or self._acted is None or self._acted[0].shape != state.shape:
            return
        parts = (part.to(state) for part in self._acted)
        before, planned, executed = (part.reshape(-1, part.shape[-1]) for part in parts)
        self._acted, after = None, state.reshape(-1, state.shape[-1])
        begins = torch.ones(len(after), dtype=torch.bool)
        if self._next is not None and self._next.shape == after.shape:
            begins = (self._next != before).any(-1).cpu()
        elif len(self._episode) != len(after):
            first = int(self._episode.max(initial=-1))
            self._episode = first + np.arange(len(after)) - len(after) + 1
            self._steps = np.zeros(len(after), dtype=int)
        self._next = after
        new = begins.numpy()
        self._episode[new] = self._episode.max() + 1 + np.arange(new.sum())
        self._steps = np.where(new, 0, self._steps + 1)
        seen = effective_action(model, before, executed, after, scale.to(executed), quiet=-1.0)
        effective = torch.where(seen.std < 1, seen.action, torch.nan)
        sound = (before.isfinite().all(-1) & after.isfinite().all(-1)).cpu().numpy()
        table = torch.cat([planned, executed, effective, before], -1).double().cpu().numpy()
        lines, dt = [], getattr(model, "dt", None)
        for episode, step, row in zip(
            self._episode[sound], self._steps[sound], table[sound], strict=True
        ):
            times = [] if dt is None else [f"{step * dt:.9g}"]
            numbers = ("" if np.isnan(number) else f"{number:.9g}" for number in row)
            lines.append([str(episode), *times, *numbers])
        if lines:
            self._append(lines, model)

    def _append(self, lines: list[list[str]], model: Any) -> None:
        text = io.StringIO()
        with refusing(f"record={str(self.file)!r}: cannot be written"):
            if self._handle is None:
                self.file.parent.mkdir(parents=True, exist_ok=True)
                how = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND
                self._handle = os.open(self.file, how, 0o644)
                self._writer, lines = os.getpid(), [_columns(model), *lines]
            if self._writer != os.getpid():
                raise ConfigurationError(
                    f"record={str(self.file)!r}: process {self._writer} writes it, this one is a "
                    "copy of that; expected a file for each process: set record after the fork"
                )
            csv.writer(text, lineterminator="\n").writerows(lines)
            rows, size = text.getvalue().encode(), os.fstat(self._handle).st_size
        try:
            if os.write(self._handle, rows) < len(rows):
                os.ftruncate(self._handle, size)  # no cut line
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:  # the episode continues
            self._ended = True
            warn(f"record={str(self.file)!r}: no more is recorded: {error.strerror}")

    def __del__(self) -> None:
        if (handle := getattr(self, "_handle", None)) is not None:
            os.close(handle)


def _columns(model: Any) -> list[str]:
    """Return the names of columns: those of the model, or numbers."""
    sizes = (model.state_size, model.action_size)
    states, actions = getattr(model, "names", None) or (range(size) for size in sizes)
    actions = list(actions)
    names = ["episode_index", *(["t"] if hasattr(model, "dt") else [])]
    names += [f"{kind}.{x}" for kind in KINDS for x in actions]
    return [*names, *(f"state.{x}" for x in states)]
