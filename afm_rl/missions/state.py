"""The whole state of missions under way: written down, and taken up again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.optim import Optimizer

from afm_rl.artefacts import digest_of
from afm_rl.missions.build import Agent
from afm_rl.missions.log import StepLog
from afm_rl.streams import Streams

COUNTERS = ("discarded", "refused")  # of planners and updaters, for people


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


class Holder(NamedTuple):
    """Something with a state of its own."""

    read: Callable[[], Any]
    write: Callable[[Any], Any]


def snapshot(agent: Agent, loop: Loop) -> dict[str, Any]:
    """Return everything that the next steps and the tables depend on.

    That is the loop itself, all tensors of the agent's modules (also those that are not
    persistent), whatever in them has a state of its own (generators, :class:`Streams`,
    optimisers, an extra state as defined by ``nn.Module``), and the global generator.
    """
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
            parameters[name].data = value
        else:
            owner, _, leaf = name.rpartition(".")
            modules[owner]._buffers[leaf] = value
    for name, holder in _holders(whole):
        holder.write(state["held"][name])
    torch.random.set_rng_state(state["global"])
    loop.log.load_state_dict(state["log"])
    loop.ids, loop.ends, loop.step = state["ids"], state["ends"], state["step"]
    loop.td = TensorDict(state["td"], loop.ids.shape, device=loop.td.device)


def fingerprint(agent: Agent) -> str:
    """Return a digest of all tensors of an agent: of its models, flows and tracks."""
    whole = _whole(agent)
    tensors = {**dict(whole.named_parameters()), **dict(whole.named_buffers())}
    return digest_of({name: value.detach().contiguous() for name, value in tensors.items()})


def _whole(agent: Agent) -> nn.ModuleDict:
    """Return all modules of an agent as one; a module that is shared has one name."""
    parts = {"model": agent.model, "env": agent.env}
    return nn.ModuleDict({**parts, "planner": agent.planner, "updater": agent.updater})


def _holders(whole: nn.Module) -> Iterator[tuple[str, Holder]]:
    for name, module in whole.named_modules():
        if type(module).get_extra_state is not nn.Module.get_extra_state:
            yield name, Holder(module.get_extra_state, module.set_extra_state)
        for attribute, value in list(vars(module).items()):
            path = f"{name}.{attribute}"
            if isinstance(value, torch.Generator):
                yield path, Holder(value.get_state, value.set_state)
            elif isinstance(value, Streams | Optimizer):
                yield path, Holder(value.state_dict, value.load_state_dict)
            elif attribute in COUNTERS:
                read, write = (partial(f, module, attribute) for f in (getattr, setattr))
                yield path, Holder(read, write)
