"""Missions under way, on disk: what a killed run goes on from."""

from __future__ import annotations

import time
from pathlib import Path

from afm_rl._version import __version__
from afm_rl.artefacts import read_tensors, save_tensors
from afm_rl.errors import AFMError, ArtefactError, check_number
from afm_rl.missions.build import Agent
from afm_rl.missions.settings import differences, influential
from afm_rl.missions.state import Loop, fingerprint, restore, snapshot
from afm_rl.missions.tree import flatten, unflatten


class Stopped(AFMError):
    """Missions were told to stop before their end."""


class Checkpoint:
    """A file that holds the state of an agent's missions.

    Args:
        path: the file; it is replaced as a whole, so there is always one that can be read.
        agent: prepared, before its first step.
        every: seconds between two writes; 0 writes after each step.

    Raises:
        ConfigurationError: for a time that cannot be used.
    """

    def __init__(self, path: Path, agent: Agent, every: float = 60.0) -> None:
        self.path = Path(path)
        self.agent = agent
        self.every = check_number("every", every, low=0.0)
        self.description = {
            "version": __version__,
            "settings": influential(agent.settings),
            "parts": fingerprint(agent),
        }
        self._last = time.monotonic()

    def resume(self, loop: Loop) -> None:
        """Go on from the file, if there is one.

        Raises:
            ArtefactError: if it is damaged, or belongs to other settings or parts.
        """
        if not self.path.exists():
            return
        tensors, stored = read_tensors(self.path)
        wanted = self.description
        apart = differences({name: stored.get(name) for name in wanted}, wanted)
        if apart:
            raise ArtefactError(
                f"{self.path}: was made by other missions ({'; '.join(apart)}); delete it to "
                "start anew"
            )
        # Copies: what is read may lie anywhere in a file that is mapped, and where numbers lie
        # can decide how products of matrices are rounded.
        tensors = {name: value.clone() for name, value in tensors.items()}
        restore(self.agent, loop, unflatten(tensors, stored["values"]))

    def keep(self, loop: Loop) -> None:
        """Write the file if it is time to."""
        if time.monotonic() - self._last >= self.every:
            self.write(loop)

    def write(self, loop: Loop) -> None:
        """Write the file.

        Raises:
            ConfigurationError: if it cannot be written; the one before stays.
        """
        tensors, values = flatten(snapshot(self.agent, loop))
        tensors = {name: value.detach().clone() for name, value in tensors.items()}
        save_tensors(self.path, tensors, {**self.description, "values": values})
        self._last = time.monotonic()
