"""Trained parts, and the state of work under way, on disk: safetensors with checksums."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Annotated, Any

from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn

from afm_rl.errors import ArtefactError, ConfigurationError, refusing
from afm_rl.options import Count, NonNegative, options
from afm_rl.storage.files import locked, remove_parts, write_whole
from afm_rl.storage.manifest import differences, leaves

FILES = "checkpoint-*.safetensors"


def save_artefact(path: Path, module: nn.Module, description: Mapping[str, Any]) -> None:
    """Save a module's state with a JSON description and a checksum of both."""
    save_tensors(path, module.state_dict(), description)


def save_tensors(path: Path, tensors: Mapping[str, Tensor], description: Mapping[str, Any]) -> None:
    """Save tensors with a JSON description and a checksum of both."""
    tensors = {name: value.contiguous() for name, value in tensors.items()}
    text = json.dumps(description, sort_keys=True)
    metadata = {"description": text, "sha256": digest_of(tensors, text)}
    write_whole(Path(path), save(tensors, metadata))


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors and the description that :func:`save_tensors` wrote.

    Raises:
        ConfigurationError: if there is no such file.
        ArtefactError: if it is damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise ConfigurationError(f"{path}: no such file")
    with (
        refusing(f"{path}: damaged, or no safetensors file", ArtefactError),
        safe_open(path, framework="pt") as file,
    ):
        metadata = file.metadata() or {}
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    text = metadata.get("description", "")
    if metadata.get("sha256") != digest_of(tensors, text):
        raise ArtefactError(f"{path}: damaged: its checksum does not match; delete it")
    return tensors, json.loads(text)


def load_artefact(path: Path, module: nn.Module, description: Mapping[str, Any]) -> dict[str, Any]:
    """Load a module's state, if it is whole and fits; return the file's description.

    Raises:
        ConfigurationError: if there is no such file.
        ArtefactError: if it is damaged, or belongs to something else.
    """
    tensors, stored = read_tensors(path)
    for name, wanted in json.loads(json.dumps(description)).items():  # a tuple becomes a list
        if stored.get(name) != wanted:
            raise ArtefactError(
                f"{path}: was made for {name}={stored.get(name)}, expected {name}={wanted}"
            )
    with refusing(f"{path}: does not fit", ArtefactError):
        deepcopy(module).load_state_dict(tensors)  # all of it, before anything changes
    module.load_state_dict(tensors)
    return stored


def cached(
    folder: Path,
    module: nn.Module,
    description: Mapping[str, Any],
    train: Callable[[], Any],
) -> tuple[Any, bool]:
    """Load a trained module from the cache, or train and store it.

    Args:
        folder: the cache.
        module: what is trained, in place.
        description: everything the result depends on; its hash names the file. Its ``name``
            begins the file name.
        train: trains ``module`` and returns its held-out error, or more, for JSON.

    Returns:
        What ``train`` returned, and whether it came from the cache.
    """
    text = json.dumps(description, sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    path = Path(folder) / f"{description['name']}-{digest}.safetensors"
    with locked(path.parent, f".{path.name}.lock", wait=True):  # the second one need not train
        if path.exists():
            return load_artefact(path, module, description)["held_out_error"], True
        remove_parts(path.parent, path.name)
        error = train()
        save_artefact(path, module, {**description, "held_out_error": error})
        return error, False


def digest_of(tensors: Mapping[str, Tensor], text: str = "") -> str:
    """Return the SHA-256 of named tensors and a text.

    >>> digest_of({}) == digest_of({}, "a")
    False
    """
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        digest.update(f"{name}{tensors[name].dtype}{tuple(tensors[name].shape)}".encode())
        digest.update(tensors[name].cpu().numpy().tobytes())
    return digest.hexdigest()


class Checkpoints:
    """The last checkpoints of some work, in a folder.

    They are named after the next step: ``checkpoint-0000312.safetensors``.

    Args:
        folder: where they are; made if it is not there.
        owner: whose state it is; a state of another owner is refused.

    >>> import tempfile, torch
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     Checkpoints(folder, {"seed": 3}).write(1, {"x": {0: torch.ones(2)}, "name": "ring"})
    ...     Checkpoints(folder, {"seed": 3}).read()
    {'x': {0: tensor([1., 1.])}, 'name': 'ring'}
    """

    @options("checkpoints")
    def __init__(
        self,
        folder: str | Path,
        owner: Mapping[str, Any],
        every: Annotated[
            NonNegative, "seconds between two checkpoints; 0: one after each step"
        ] = 60.0,
        keep: Annotated[Count, "number of checkpoints kept"] = 2,
    ) -> None:
        self.folder, self.owner, self.every, self.keep = Path(folder), dict(owner), every, keep
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
        remedy = f"to go on from {before[-1].name}" if before else "to start again"
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
        named = {json.dumps(path): leaf for path, leaf in leaves(state)}
        tensors = {k: v.detach().clone() for k, v in named.items() if isinstance(v, Tensor)}
        values = {name: leaf for name, leaf in named.items() if name not in tensors}
        remove_parts(self.folder)
        path = self.folder / FILES.replace("*", f"{step:07d}")
        save_tensors(path, tensors, {**self.owner, "values": values})
        for old in self.paths[: -self.keep]:
            old.unlink()
        self._last = time.monotonic()
