"""Policies that Stable-Baselines3 or CleanRL trained: their weights, without their code."""

from __future__ import annotations

import json
import math
import pickletools
import re
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from gymnasium.spaces import Box
from torch import Tensor

from afm_rl.errors import ArtefactError, ConfigurationError, refusing
from afm_rl.planning.policies import StoredPolicy
from afm_rl.storage.files import read_bounded
from afm_rl.storage.torch_files import LARGEST, BoundedZip, read_saved

NO_WEIGHTS = "no weights in it that can be read"
OPERATIONS = 2**18  # of a normaliser's pickle, which are looked at


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
    content = read_bounded(Path(file), LARGEST)
    said = f"{file}: no model of Stable-Baselines3 with a vector of actions"
    with refusing(said, ArtefactError):
        archive = BoundedZip(content)
        data, weights = json.loads(archive.take("data", 2**21)), archive.take("policy.pth")
        low, high = (_numbers(data["action_space"][end]) for end in ("low", "high"))
        chosen = dict(data.get("policy_kwargs") or {})
        limit = float(chosen.get("clip_mean", 2.0))
        activation = re.search(r"activation\.(\w+)", str(chosen.get("activation_fn")))
        searched_at_random = "ARSPolicy." in str(data.get("policy_class"))
    about: dict[str, Any] = {}
    if activation:
        about["activation"] = activation[1].lower()
    if "squash_output" in chosen:
        about["squash"] = bool(chosen["squash_output"])
    if searched_at_random:
        about = {"activation": "relu", "squash": True, **about}
    with refusing(f"{file}: {NO_WEIGHTS}", ArtefactError):
        state = read_saved(weights)
    if "actor.mu.0.weight" in state and "actor.log_std" in state:  # state-dependent exploration
        about["limit"] = limit
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
    content = read_bounded(Path(file), LARGEST)
    with refusing(f"{file}: {NO_WEIGHTS}", ArtefactError):
        state = read_saved(content)
    low, high = torch.from_numpy(space.low), torch.from_numpy(space.high)
    return _policy(state, low, high, about, file)


def read_normaliser(file: str | Path) -> tuple[Tensor, float]:
    """Return mean and standard deviation ``(2, O)`` and clip of a saved ``VecNormalize``.

    The file is a pickle. It is not unpickled: its stream of operations is read for the numbers that
    follow these names, which can do no harm.

    Raises:
        ConfigurationError: if there is no such file.
        ArtefactError: if it holds no mean and variance.
    """
    wanted, word, began = "", None, False
    content = read_bounded(Path(file), LARGEST)
    found: dict[str, Any] = {}
    known: dict[Any, str | None] = {}
    said = f"{file}: no mean and variance of observations in it; VecNormalize.save writes them"
    with refusing(said, ArtefactError):
        for code, value, _ in islice(pickletools.genops(content), OPERATIONS):
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


def _numbers(text: str) -> Tensor:
    """Read an array as it is printed."""
    return torch.tensor([float(word) for word in text.strip("[]").split()])


def _policy(
    state: Mapping[str, Tensor], low: Tensor, high: Tensor, about: dict[str, Any], file: str | Path
) -> StoredPolicy:
    names = [name for name in state if name.endswith(".weight")]
    of_actor: list[str] = []
    # How the weights of an actor are called, hidden layers and last one; its usual activation; and
    # whether a tanh ends it.
    shared = ("mlp_extractor.shared_net.", "mlp_extractor.policy_net.")
    actors = (
        (("actor.latent_pi.", "actor.mu."), ("actor.mu.",), "relu", True),  # SAC, TQC, TD3, DDPG
        (shared, ("action_net.",), "tanh", False),
        (("fc1.", "fc2."), ("fc_mean.", "fc_mu."), "relu", True),  # CleanRL's SAC, TD3, DDPG
        (("actor_mean.",), ("actor_mean.",), "tanh", False),  # CleanRL's PPO
    )
    for hidden, last, *usual in actors:
        if any(name.startswith(last) for name in names):
            of_actor = [name for name in names if name.startswith(hidden + last)]
            about = {**dict(zip(("activation", "squash"), usual, strict=True)), **about}
            break
    if not of_actor:
        raise ArtefactError(
            f"{file}: no actor of a known kind among {sorted(names)[:8]}; expected feed-forward "
            "PPO, A2C, TRPO, SAC, TQC, TD3, DDPG or ARS over a vector of numbers"
        )
    layers = [
        (state[x], state.get(x.replace(".weight", ".bias"), torch.zeros(state[x].shape[:1])))
        for x in of_actor
    ]
    try:
        return StoredPolicy(layers, low, high, **about)
    except ConfigurationError as error:
        raise ConfigurationError(f"{file}: {error}") from error
