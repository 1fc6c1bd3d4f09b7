"""Checkpoints: the state of work under way, in files that a killed run goes on from.

A state is nested dictionaries of tensors, numbers, texts and lists. It is stored as safetensors:
each tensor under its path in the dictionaries, all else as JSON, with a SHA-256 of both.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from afm_rl.errors import ArtefactError, check_count, check_number
from afm_rl.storage.artefacts import read_tensors, save_tensors
from afm_rl.storage.files import remove_parts
from afm_rl.storage.settings import differences

FILES = "checkpoint-*.safetensors"


class Checkpoints:
    """The last checkpoints of some work, in a folder.

    They are named after the next step: ``checkpoint-0000312.safetensors``.

    Args:
        folder: where they are; made if it is not there.
        owner: whose state it is; a state of another owner is refused.
        every: time between two of them (s); 0 writes one after each step.
        keep: how many to keep.

    Raises:
        ConfigurationError: for settings that cannot be used.

    >>> import tempfile, torch
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     Checkpoints(folder, {"seed": 3}).write(1, {"x": {0: torch.ones(2)}, "name": "ring"})
    ...     Checkpoints(folder, {"seed": 3}).read()
    {'x': {0: tensor([1., 1.])}, 'name': 'ring'}
    """

    def __init__(
        self, folder: str | Path, owner: Mapping[str, Any], every: float = 60.0, keep: int = 2
    ) -> None:
        self.folder, self.owner = Path(folder), dict(owner)
        self.every = check_number("checkpoints.every", every, low=0.0)
        self.keep = check_count("checkpoints.keep", keep)
        self._last = time.monotonic()

    @property
    def due(self) -> bool:
        """Whether the last one is old enough for the next one."""
        return time.monotonic() - self._last >= self.every

    @property
    def paths(self) -> list[Path]:
        """The files that are there, oldest first."""
        return sorted(self.folder.glob(FILES))

    def read(self) -> dict[Any, Any] | None:
        """Return the state in the latest file; None if there is no file.

        Raises:
            ArtefactError: if the file is damaged, or belongs to another owner.
        """
        if not self.paths:
            return None
        *before, path = self.paths
        remedy = f"to go on from {before[-1].name}" if before else "to start anew"
        try:
            tensors, stored = read_tensors(path)
        except ArtefactError as error:
            raise ArtefactError(f"{error} {remedy}") from error
        apart = differences({name: stored.get(name) for name in self.owner}, self.owner)
        if apart:
            raise ArtefactError(
                f"{path}: was made by other missions ({'; '.join(apart)}); delete it {remedy}"
            )
        # Copies: what is read may lie anywhere in a file that is mapped, and where numbers lie
        # can decide how products of matrices are rounded.
        tensors = {name: value.clone() for name, value in tensors.items()}
        tree: dict[Any, Any] = {}
        for name, value in (*tensors.items(), *stored["values"].items()):
            *above, last = json.loads(name)
            place = tree
            for key in above:
                place = place.setdefault(key, {})
            place[last] = value
        return tree

    def write(self, step: int, state: Mapping[Any, Any]) -> None:
        """Write a state before a step, and remove the oldest files.

        Raises:
            ConfigurationError: if it cannot be written; those before stay.
        """
        leaves = {json.dumps(path): leaf for path, leaf in _leaves(state)}
        tensors = {k: v.detach().clone() for k, v in leaves.items() if isinstance(v, Tensor)}
        values = {name: leaf for name, leaf in leaves.items() if name not in tensors}
        remove_parts(self.folder)
        path = self.folder / FILES.replace("*", f"{step:07d}")
        save_tensors(path, tensors, {**self.owner, "values": values})
        for old in self.paths[: -self.keep]:
            old.unlink()
        self._last = time.monotonic()


def _leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield what nested dictionaries hold, with its path; empty ones stay whole."""
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from _leaves(inner, (*path, key))
    else:
        yield path, dict(value) if isinstance(value, Mapping) else value
