"""The whole state of missions under way: written down, and taken up again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.optim import Optimizer

from afm_rl._version import __version__
from afm_rl.missions.build import Agent
from afm_rl.missions.log import StepLog
from afm_rl.missions.unsaved import PLAIN, TORCH, check_saved, has_extra_state, whole
from afm_rl.storage.artefacts import digest_of
from afm_rl.storage.manifest import influential
from afm_rl.streams import Streams


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


def snapshot(agent: Agent, loop: Loop) -> dict[str, Any]:
    """Return everything that the next steps and the tables depend on.

    That is the loop itself, the global generator, and of each module of the agent: all tensors
    (also those that are not persistent), plain numbers and texts, and whatever has a state of its
    own (generators, :class:`Streams`, optimisers, an extra state as defined by ``nn.Module``).

    Raises:
        ConfigurationError: if something else has changed since the start, see
            :func:`check_saved`.
    """
    check_saved(agent, loop.unsaved)
    return {
        "td": loop.td.to_dict(),
        "ids": loop.ids,
        "ends": loop.ends,
        "log": loop.log.state_dict(),
        "step": loop.step,
        "global": torch.random.get_rng_state(),
        "agent": {name: read() for name, read, _ in _holders(agent)},
    }


def restore(agent: Agent, loop: Loop, state: dict[str, Any]) -> None:
    """Put ``agent`` and ``loop`` where a :func:`snapshot` was taken.

    Args:
        agent: like the one of the snapshot, at the start of its missions.
        loop: at their start.
        state: the snapshot; what it holds is taken over, not copied.
    """
    for name, _, write in _holders(agent):
        write(state["agent"][name])
    torch.random.set_rng_state(state["global"])
    loop.log.load_state_dict(state["log"])
    loop.ids, loop.step = state["ids"].to(agent.device), state["step"]
    loop.ends = {name: part.to(agent.device) for name, part in state["ends"].items()}
    loop.td = TensorDict(state["td"], loop.ids.shape, device=loop.td.device)


def _holders(agent: Agent) -> Iterator[tuple[str, Callable[[], Any], Callable[[Any], Any]]]:
    """Yield all of an agent that has a state: its name, how it is read, and how it is written."""
    for path, module in whole(agent).named_modules():
        own = [(name, value) for name, value in vars(module).items() if name not in TORCH]
        # An optimiser knows the parameters: only their data may change.
        places: list[tuple[str, Any, str]] = [
            *((name, p, "data") for name, p in module._parameters.items() if p is not None),
            *((name, module, name) for name in module._buffers),
            *((name, module, name) for name, value in own if isinstance(value, PLAIN)),
        ]
        for name, owner, leaf in places:
            write = partial(_set, agent.device, owner, leaf)
            yield f"{path}.{name}", partial(getattr, owner, leaf), write
        if has_extra_state(module):
            yield path, module.get_extra_state, module.set_extra_state
        for name, value in own:
            if isinstance(value, torch.Generator):
                yield f"{path}.{name}", value.get_state, value.set_state
            elif isinstance(value, Streams | Optimizer):
                yield f"{path}.{name}", value.state_dict, value.load_state_dict


def _set(device: torch.device, owner: Any, name: str, value: Any) -> None:
    """Set an attribute, a tensor on the agent's device."""
    if isinstance(value, Tensor):
        setattr(owner, name, value.to(device))
    elif getattr(owner, name) != value:
        setattr(owner, name, value)


def leave(agent: Agent, loop: Loop, keep: Tensor) -> None:
    """Go on with the missions in ``keep`` only: the others are finished.

    Raises:
        ConfigurationError: if something per mission cannot be cut, see :func:`check_saved`.
    """
    loop.ids, loop.td = loop.ids[keep], loop.td[keep]
    agent.model.select_(keep)
    agent.updater.follow()
    check_saved(agent, loop.unsaved)


def owner(agent: Agent) -> dict[str, Any]:
    """Return what tells the missions of an agent from others: version, settings and parts."""
    return {
        "version": __version__,
        "settings": influential(agent.settings),
        "parts": fingerprint(agent),
    }


def fingerprint(agent: Agent) -> str:
    """Return a digest of all tensors of an agent: of its models, flows and tracks."""
    both = whole(agent)
    tensors = {**dict(both.named_parameters()), **dict(both.named_buffers())}
    return digest_of({name: value.detach().contiguous() for name, value in tensors.items()})
