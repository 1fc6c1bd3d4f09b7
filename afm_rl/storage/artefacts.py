"""Trained parts on disk: safetensors with checksums."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.storage.files import locked, remove_parts, write_whole


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
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ArtefactError(f"{path}: damaged, or no safetensors file ({error})") from error
    text = metadata.get("description", "")
    if metadata.get("sha256") != digest_of(tensors, text):
        raise ArtefactError(f"{path}: damaged: its checksum does not match; delete it")
    return tensors, json.loads(text)


def load_artefact(path: Path, module: nn.Module, description: Mapping[str, Any]) -> dict[str, Any]:
    """Load a module's state, if it is whole and fits; return the file's description.

    Args:
        path: file written by :func:`save_artefact`.
        module: receives the state.
        description: entries that the file's description must have.

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
    found = {name: tuple(value.shape) for name, value in tensors.items()}
    needed = {name: tuple(value.shape) for name, value in module.state_dict().items()}
    if found != needed:
        apart = sorted(name for name, _ in found.items() ^ needed.items())
        raise ArtefactError(
            f"{path}: does not fit {type(module).__name__}: {apart[0]} has shape "
            f"{found.get(apart[0])}, expected {needed.get(apart[0])}"
        )
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
