"""What of an agent nobody saves or cuts: it must not change during missions."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer
from torchrl.envs import EnvBase

from afm_rl.compiling.devices import CastCache
from afm_rl.errors import ConfigurationError
from afm_rl.mission_state import MissionState
from afm_rl.missions.build import Agent
from afm_rl.regimes import Regime
from afm_rl.storage.artefacts import digest_of
from afm_rl.streams import Streams

PLAIN = (bool, int, float, str, type(None))
LIBRARIES = ("torch", "torchrl", "tensordict")  # their modules fill caches of their own
TORCH = frozenset(vars(nn.Module()))  # attributes that every module has


def check_saved(agent: Agent, before: Mapping[str, Any]) -> None:
    """Check that nothing changes which is neither saved in checkpoints nor cut with the missions.

    Args:
        agent: during its missions.
        before: what :func:`unsaved` found at their start.

    Raises:
        ConfigurationError: naming the attribute.
    """
    now = unsaved(agent)
    changed = sorted(name for name in now if now[name] != before.get(name, now[name]))
    changed += sorted(now.keys() - before.keys() if before else ())
    if changed:
        raise ConfigurationError(
            f"{changed[0]} changes during missions, but is neither saved in checkpoints nor cut "
            "when missions finish; keep what belongs to single missions in an "
            "afm_rl.mission_state.MissionState, and give the rest out by get_extra_state"
        )


def unsaved(agent: Agent) -> dict[str, Any]:
    """Return a description of what :func:`snapshot` does not save or no one cuts, by name.

    These are attributes that are not plain, and buffers outside the model that belong to no
    :class:`~afm_rl.mission_state.MissionState`. Environments keep their state in the tensordict.
    """
    found = {}
    for name, module in whole(agent).named_modules():
        if isinstance(module, MissionState | EnvBase) or has_extra_state(module):
            continue
        if type(module).__module__.partition(".")[0] in LIBRARIES:
            continue
        for leaf, value in vars(module).items():
            if leaf not in TORCH and not isinstance(value, PLAIN):
                found[f"{name}.{leaf}"] = _described(value)
        if not name.startswith("model"):
            for leaf, buffer in module.named_buffers(recurse=False):
                found[f"{name}.{leaf}"] = _described(buffer)
    return found


def _described(value: Any, above: tuple[int, ...] = ()) -> Any:
    """Return what can be compared with the same a while later."""
    if isinstance(value, PLAIN):
        return value
    if isinstance(value, Tensor):
        return digest_of({"": value.detach().contiguous()})
    kinds = nn.Module | torch.Generator | Streams | Optimizer | Regime | CastCache
    if isinstance(value, kinds) or callable(value):
        return None  # saved by themselves, or without a state that matters
    if id(value) in above:
        return None
    above = (*above, id(value))
    if isinstance(value, Mapping):
        return [(repr(key), _described(part, above)) for key, part in value.items()]
    if isinstance(value, list | tuple | deque):
        return [_described(part, above) for part in value]
    if hasattr(value, "__dict__"):
        return _described(vars(value), above)
    return repr(value)


def whole(agent: Agent) -> nn.ModuleDict:
    """Return all modules of an agent as one; a module that is shared has one name."""
    parts = {"model": agent.model, "env": agent.env}
    return nn.ModuleDict({**parts, "planner": agent.planner, "updater": agent.updater})


def has_extra_state(module: nn.Module) -> bool:
    """Return whether a module gives out a state of its own kind."""
    return type(module).get_extra_state is not nn.Module.get_extra_state
