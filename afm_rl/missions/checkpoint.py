"""Checkpoints: the state of missions under way, in files that a killed run goes on from."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from afm_rl._version import __version__
from afm_rl.errors import AFMError, ArtefactError, check_count, check_number
from afm_rl.missions.build import Agent
from afm_rl.missions.settings import differences, influential
from afm_rl.missions.state import Loop, fingerprint, restore, snapshot
from afm_rl.missions.tree import flatten, unflatten
from afm_rl.storage.artefacts import read_tensors, save_tensors
from afm_rl.storage.files import remove_parts

FILES = "checkpoint-*.safetensors"


class Stopped(AFMError):
    """Missions were told to stop before their end."""


class Checkpoints:
    """The last checkpoints of an agent's missions, in a folder.

    They are named after the next step: ``checkpoint-0000312.safetensors``.

    Args:
        folder: where they are; made if it is not there.
        agent: prepared, before its first step.
        every: seconds between two of them; 0 writes one after each step.
        keep: how many to keep.

    Raises:
        ConfigurationError: for settings that cannot be used.
    """

    def __init__(self, folder: Path, agent: Agent, every: float = 60.0, keep: int = 2) -> None:
        self.folder = Path(folder)
        self.agent = agent
        self.every = check_number("checkpoints.every", every, low=0.0)
        self.keep = check_count("checkpoints.keep", keep)
        self.description = {
            "version": __version__,
            "settings": influential(agent.settings),
            "parts": fingerprint(agent),
        }
        self._last = time.monotonic()

    @property
    def paths(self) -> list[Path]:
        """The files that are there, oldest first."""
        return sorted(self.folder.glob(FILES))

    def read(self) -> dict[str, Any] | None:
        """Return the state in the latest file; None if there is no file.

        The agent stays as it is: see :meth:`resume`.

        Raises:
            ArtefactError: if the file is damaged, or belongs to other settings or parts.
        """
        if not self.paths:
            return None
        *before, path = self.paths
        remedy = f"to go on from {before[-1].name}" if before else "to start anew"
        try:
            tensors, stored = read_tensors(path)
        except ArtefactError as error:
            raise ArtefactError(f"{error} {remedy}") from error
        wanted = self.description
        apart = differences({name: stored.get(name) for name in wanted}, wanted)
        if apart:
            raise ArtefactError(
                f"{path}: was made by other missions ({'; '.join(apart)}); delete it {remedy}"
            )
        # Copies: what is read may lie anywhere in a file that is mapped, and where numbers lie
        # can decide how products of matrices are rounded.
        tensors = {name: value.clone() for name, value in tensors.items()}
        return unflatten(tensors, stored["values"])

    def resume(self, loop: Loop, state: dict[str, Any]) -> None:
        """Put the agent and its loop where ``state``, from :meth:`read`, was taken."""
        restore(self.agent, loop, state)

    def write_if_due(self, loop: Loop) -> None:
        """Write a file if the last one is old enough."""
        if time.monotonic() - self._last >= self.every:
            self.write(loop)

    def write(self, loop: Loop) -> None:
        """Write a file, and remove the oldest ones.

        Raises:
            ConfigurationError: if it cannot be written; those before stay.
        """
        tensors, values = flatten(snapshot(self.agent, loop))
        tensors = {name: value.detach().clone() for name, value in tensors.items()}
        path = self.folder / FILES.replace("*", f"{loop.step:07d}")
        remove_parts(self.folder)
        save_tensors(path, tensors, {**self.description, "values": values})
        for old in self.paths[: -self.keep]:
            old.unlink()
        self._last = time.monotonic()
