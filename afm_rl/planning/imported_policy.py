"""Policies that Stable-Baselines3 or CleanRL trained: their weights, read without a pickle."""

from __future__ import annotations

import io
import json
import math
import pickletools
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from gymnasium.spaces import Box
from torch import Tensor

from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.planning.policies import StoredPolicy

# How the weights of an actor are called, hidden layers and last one; its usual activation; and
# whether a tanh ends it.
ACTORS = (
    (("actor.latent_pi.", "actor.mu."), ("actor.mu.",), "relu", True),  # SAC, TQC, TD3, DDPG
    (("mlp_extractor.shared_net.", "mlp_extractor.policy_net."), ("action_net.",), "tanh", False),
    (("fc1.", "fc2."), ("fc_mean.", "fc_mu."), "relu", True),  # CleanRL's SAC, TD3, DDPG
    (("actor_mean.",), ("actor_mean.",), "tanh", False),  # CleanRL's PPO
)


def policy_from_sb3(file: str | Path, normaliser: str | Path | None = None) -> StoredPolicy:
    """Return the deterministic policy of a model that Stable-Baselines3 saved.

    Of PPO, A2C, TRPO, SAC, TQC, TD3, DDPG and ARS, in this and older versions, with feed-forward
    networks over a vector of numbers. Nothing in the file is executed: weights are read as tensors
    alone, settings from its JSON, and the numbers of the normaliser from its byte stream.

    Args:
        file: what ``model.save`` wrote, a zip.
        normaliser: what ``VecNormalize.save`` wrote, if observations were normalised.

    Raises:
        ConfigurationError: if there is no such file.
        ArtefactError: if it holds no such policy.
    """
    _existing(file)
    try:
        with zipfile.ZipFile(file) as archive:
            data, weights = json.loads(archive.read("data")), archive.read("policy.pth")
        space = data["action_space"]
        low, high = (_numbers(space[end]) for end in ("low", "high"))
    except (zipfile.BadZipFile, KeyError, ValueError, TypeError, AttributeError) as error:
        raise ArtefactError(
            f"{file}: no model of Stable-Baselines3 with a vector of actions ({error!r})"
        ) from error
    chosen = data.get("policy_kwargs") or {}
    about: dict[str, Any] = {}
    if named := re.search(r"activation\.(\w+)", str(chosen.get("activation_fn"))):
        about["activation"] = named[1].lower()
    if "squash_output" in chosen:
        about["squash"] = bool(chosen["squash_output"])
    if "ARSPolicy." in str(data.get("policy_class")):
        about = {"activation": "relu", "squash": True, **about}
    state = _read_weights(weights, file)
    if "actor.mu.0.weight" in state and "actor.log_std" in state:  # state-dependent exploration
        about["limit"] = float(chosen.get("clip_mean", 2.0))
    if normaliser is not None:
        about["normaliser"], about["clip"] = read_normaliser(normaliser)
    return _policy(state, low, high, about, file)


def policy_from_cleanrl(
    file: str | Path, space: Box, normaliser: tuple[Tensor, float] | None = None
) -> StoredPolicy:
    """Return the deterministic policy of an agent that CleanRL saved (``.cleanrl_model``).

    Of its PPO, SAC, TD3 and DDPG for continuous actions.

    Args:
        file: what ``torch.save`` wrote of the agent's, or the actor's, ``state_dict``.
        space: the task's actions.
        normaliser: mean and standard deviation ``(2, O)`` of the observations and where they are
            clipped, which CleanRL's PPO keeps in its environment and does not save.

    Raises:
        ConfigurationError: if there is no such file.
        ArtefactError: if it holds no such policy.
    """
    about = {} if normaliser is None else {"normaliser": normaliser[0], "clip": normaliser[1]}
    state = _read_weights(_existing(file).read_bytes(), file)
    low, high = torch.from_numpy(space.low), torch.from_numpy(space.high)
    return _policy(state, low, high, about, file)


def read_normaliser(file: str | Path) -> tuple[Tensor, float]:
    """Return mean and standard deviation ``(2, O)`` and clip of a saved ``VecNormalize``.

    The file is a pickle. It is not unpickled: its stream of operations is read for the numbers that
    follow these names, which can do no harm.
    """
    content, wanted, word, began = _existing(file).read_bytes(), "", None, False
    found: dict[str, Any] = {}
    known: dict[Any, str | None] = {}
    try:
        for code, value, _ in pickletools.genops(content):
            if "PUT" in code.name or code.name == "MEMOIZE":  # words that come again have a number
                known[len(known) if value is None else value] = word
                continue
            value = known.get(value) if "GET" in code.name else value
            word = value if isinstance(value, str) else None
            began = began or word == "obs_rms"
            if began and word in ("mean", "var", "epsilon", "clip_obs"):
                wanted = word
            elif wanted in ("mean", "var") and isinstance(value, bytes) and not len(value) % 8:
                found.setdefault(wanted, torch.frombuffer(bytearray(value), dtype=torch.float64))
            elif wanted in ("epsilon", "clip_obs") and isinstance(value, float | int):
                found.setdefault(wanted, float(value))
        std = (found["var"] + found.get("epsilon", 1e-8)).sqrt()
        return torch.stack([found["mean"], std]), found.get("clip_obs", math.inf)
    except (KeyError, ValueError, RuntimeError) as error:
        raise ArtefactError(
            f"{file}: no mean and variance of a vector of observations in it ({error!r}); expected "
            "what VecNormalize.save wrote"
        ) from error


def _existing(file: str | Path) -> Path:
    if not Path(file).is_file():
        raise ConfigurationError(f"{file}: no such file")
    return Path(file)


def _numbers(text: str) -> Tensor:
    """Read an array as it is printed."""
    return torch.tensor([float(word) for word in text.strip("[]").split()])


def _read_weights(content: bytes, file: str | Path) -> Mapping[str, Tensor]:
    """Read named tensors, and nothing but tensors."""
    try:
        # The one place: formats of others. weights_only refuses whatever is not a tensor.
        found = torch.load(io.BytesIO(content), "cpu", weights_only=True)  # noqa: TID251
    except Exception as error:  # torch raises whatever its reader stumbles upon
        raise ArtefactError(f"{file}: no weights in it that can be read ({error})") from error
    found = found[0] if isinstance(found, list | tuple) and found else found  # CleanRL: the actor
    return found if isinstance(found, Mapping) else {}


def _policy(
    state: Mapping[str, Tensor], low: Tensor, high: Tensor, about: dict[str, Any], file: str | Path
) -> StoredPolicy:
    names, own = [name for name in state if name.endswith(".weight")], []
    for hidden, last, *usual in ACTORS:
        if any(name.startswith(last) for name in names):
            own = [name for name in names if name.startswith(hidden + last)]
            about = {**dict(zip(("activation", "squash"), usual, strict=True)), **about}
            break
    if not own:
        raise ArtefactError(
            f"{file}: no actor of a known kind among {sorted(names)[:8]}; expected feed-forward "
            "PPO, A2C, TRPO, SAC, TQC, TD3, DDPG or ARS over a vector of numbers"
        )
    nothing = {name: state[name].new_zeros(len(state[name])) for name in own}  # without biases
    layers = [(state[x], state.get(x.replace(".weight", ".bias"), nothing[x])) for x in own]
    return StoredPolicy(layers, low, high, **about)
