"""The whole state of missions under way: written down, and taken up again."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.optim import Optimizer
from torchrl.envs import EnvBase

from afm_rl.compiling.cast_cache import CastCache
from afm_rl.errors import ConfigurationError
from afm_rl.mission_state import MissionState
from afm_rl.missions.build import Agent
from afm_rl.missions.log import StepLog
from afm_rl.regimes import Regime
from afm_rl.storage.artefacts import digest_of
from afm_rl.streams import Streams

PLAIN = (bool, int, float, str, type(None))
LIBRARIES = ("torch", "torchrl", "tensordict")  # their modules fill caches of their own
TORCH = frozenset(vars(nn.Module()))  # attributes that every module has


@dataclass
class Loop:
    """Where missions stand between two steps."""

    td: TensorDictBase
    """What the next plan starts from, one row for each mission that runs."""
    ids: Tensor
    """Their numbers, ``(B,)``."""
    ends: dict[str, Tensor]
    """What the table of missions is made from, by column, a row for every mission."""
    log: StepLog
    """The steps so far."""
    step: int = 0
    """The next step."""
    unsaved: Mapping[str, Any] = field(default_factory=dict)
    """What :func:`unsaved` found at the start: it must not change."""


class Holder(NamedTuple):
    """Something with a state of its own."""

    read: Callable[[], Any]
    write: Callable[[Any], Any]


def snapshot(agent: Agent, loop: Loop) -> dict[str, Any]:
    """Return everything that the next steps and the tables depend on.

    That is the loop itself, all tensors of the agent's modules (also those that are not
    persistent), their plain numbers and texts, whatever in them has a state of its own
    (generators, :class:`Streams`, optimisers, an extra state as defined by ``nn.Module``), and the
    global generator.

    Raises:
        ConfigurationError: if something else has changed since the start, see
            :func:`check_saved`.
    """
    check_saved(agent, loop)
    whole = _whole(agent)
    return {
        "td": loop.td.to_dict(),
        "ids": loop.ids,
        "ends": loop.ends,
        "log": loop.log.state_dict(),
        "step": loop.step,
        "global": torch.random.get_rng_state(),
        "tensors": {**dict(whole.named_parameters()), **dict(whole.named_buffers())},
        "held": {name: holder.read() for name, holder in _holders(whole)},
        "plain": {name: getattr(module, leaf) for name, module, leaf in _plain(whole)},
    }


def restore(agent: Agent, loop: Loop, state: dict[str, Any]) -> None:
    """Put ``agent`` and ``loop`` where a :func:`snapshot` was taken.

    Args:
        agent: like the one of the snapshot, at the start of its missions.
        loop: at their start.
        state: the snapshot; what it holds is taken over, not copied.
    """
    whole = _whole(agent)
    modules, parameters = dict(whole.named_modules()), dict(whole.named_parameters())
    for name, value in state["tensors"].items():
        if name in parameters:  # the optimiser knows the parameter: only its data may change
            parameters[name].data = value.to(agent.device)
        else:
            owner, _, leaf = name.rpartition(".")
            modules[owner]._buffers[leaf] = value.to(agent.device)
    for name, holder in _holders(whole):
        holder.write(state["held"][name])
    for name, module, leaf in list(_plain(whole)):
        if getattr(module, leaf) != state["plain"].get(name):
            setattr(module, leaf, state["plain"][name])
    torch.random.set_rng_state(state["global"])
    loop.log.load_state_dict(state["log"])
    loop.ids, loop.step = state["ids"].to(agent.device), state["step"]
    loop.ends = {name: part.to(agent.device) for name, part in state["ends"].items()}
    loop.td = TensorDict(state["td"], loop.ids.shape, device=loop.td.device)


def leave(agent: Agent, loop: Loop, keep: Tensor) -> None:
    """Go on with the missions in ``keep`` only: the others are finished.

    Raises:
        ConfigurationError: if something per mission cannot be cut, see :func:`check_saved`.
    """
    loop.ids, loop.td = loop.ids[keep], loop.td[keep]
    agent.model.select_(keep)
    agent.updater.follow()
    check_saved(agent, loop)


def check_saved(agent: Agent, loop: Loop) -> None:
    """Check that nothing changes which is neither saved in checkpoints nor cut with the missions.

    Raises:
        ConfigurationError: naming the attribute.
    """
    now = unsaved(agent)
    changed = sorted(name for name in now if now[name] != loop.unsaved.get(name, now[name]))
    changed += sorted(now.keys() - loop.unsaved.keys() if loop.unsaved else ())
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
    for name, module in _whole(agent).named_modules():
        if isinstance(module, MissionState | EnvBase) or _has_extra_state(module):
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


def fingerprint(agent: Agent) -> str:
    """Return a digest of all tensors of an agent: of its models, flows and tracks."""
    whole = _whole(agent)
    tensors = {**dict(whole.named_parameters()), **dict(whole.named_buffers())}
    return digest_of({name: value.detach().contiguous() for name, value in tensors.items()})


def _whole(agent: Agent) -> nn.ModuleDict:
    """Return all modules of an agent as one; a module that is shared has one name."""
    parts = {"model": agent.model, "env": agent.env}
    return nn.ModuleDict({**parts, "planner": agent.planner, "updater": agent.updater})


def _has_extra_state(module: nn.Module) -> bool:
    return type(module).get_extra_state is not nn.Module.get_extra_state


def _plain(whole: nn.Module) -> Iterator[tuple[str, nn.Module, str]]:
    """Yield the numbers and texts among the attributes of modules: name, module, attribute."""
    for name, module in whole.named_modules():
        for leaf, value in list(vars(module).items()):
            if leaf not in TORCH and isinstance(value, PLAIN):
                yield f"{name}.{leaf}", module, leaf


def _holders(whole: nn.Module) -> Iterator[tuple[str, Holder]]:
    for name, module in whole.named_modules():
        if _has_extra_state(module):
            yield name, Holder(module.get_extra_state, module.set_extra_state)
        for attribute, value in list(vars(module).items()):
            path = f"{name}.{attribute}"
            if isinstance(value, torch.Generator):
                yield path, Holder(value.get_state, value.set_state)
            elif isinstance(value, Streams | Optimizer):
                yield path, Holder(value.state_dict, value.load_state_dict)
