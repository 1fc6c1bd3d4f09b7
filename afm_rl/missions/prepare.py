"""Training of an agent's parts before the missions, cached."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from afm_rl._version import __version__
from afm_rl.missions.build import Agent
from afm_rl.storage.artefacts import cached


def prepare(
    agent: Agent, cache: str | Path, progress: bool = False, echo: Callable[[str], None] = print
) -> None:
    """Train what needs training, or take it from the cache; say the held-out errors.

    Args:
        agent: its parts are trained in place.
        cache: folder of trained parts.
        progress: show progress bars.
        echo: receives one line per part.

    Raises:
        ConfigurationError: if the cache cannot be written; before anything is trained.
        ArtefactError: if a part in the cache is damaged.
    """
    folder = Path(cache).expanduser()

    for part in agent.trainings:
        description = {"name": part.title, "version": __version__, "settings": part.settings}
        description.update(getattr(part.module, "signature", {}))
        start = time.perf_counter()
        known, found = cached(folder, part.module, description, partial(part.train, progress))
        spent = "from the cache" if found else f"trained in {time.perf_counter() - start:.0f} s"
        known = known if isinstance(known, Mapping) else {"error": known}
        echo(f"{part.title}: held-out error {known['error']:.4f} {part.unit} ({spent})")
        if "rms" in known:
            pairs = zip(known["names"], known["rms"], strict=True)
            each = ", ".join(f"{name} {error:.2g}" for name, error in pairs)
            echo(f"{part.title}: root mean square error of a step: {each}")
        if "rewards" in known:
            rewards = ", ".join(f"{reward:.3g}" for reward in known["rewards"])
            echo(f"{part.title}: reward per step of each round of data, random first: {rewards}")
