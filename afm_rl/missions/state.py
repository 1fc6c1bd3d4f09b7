"""The whole state of missions under way: written down, and taken up again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from afm_rl._version import __version__
from afm_rl.missions.build import Agent
from afm_rl.storage.artefacts import digest_of
from afm_rl.storage.manifest import influential
from afm_rl.streams import Streams
from afm_rl.transforms.memory import MemoryHolder

if TYPE_CHECKING:
    import pandas as pd


class StepLog:
    """One row per mission and step, kept in memory until a table is asked for.

    >>> log = StepLog(["x", "reached"], whole=["reached"])
    >>> log.add(torch.tensor([4, 7]), 0, torch.tensor([[0.5, 1.0], [0.6, 2.0]]))
    >>> log.table().values.tolist()
    [[4.0, 0.0, 0.5, 1.0], [7.0, 0.0, 0.6000000238418579, 2.0]]
    """

    def __init__(self, columns: Sequence[str], whole: Sequence[str] = (), room: int = 4096) -> None:
        self.columns = list(columns)
        self.whole = list(whole)
        self._count = 0
        self._values = torch.empty(room, len(self.columns))
        self._keys = torch.empty(room, 2, dtype=torch.int64)  # mission, step

    def __len__(self) -> int:
        return self._count

    def add(self, missions: Tensor, step: int, values: Tensor) -> None:
        """Add one step of the missions ``(B,)``: ``(B, C)``."""
        rows = slice(self._count, self._count + len(missions))
        while rows.stop > len(self._keys):
            # One block that doubles: thousands of small tensors would pin the heap in pieces
            # between the large temporaries of a learning model, and memory would grow.
            self._values = torch.cat([self._values, torch.empty_like(self._values)])
            self._keys = torch.cat([self._keys, torch.empty_like(self._keys)])
        self._values[rows] = values.detach().to(self._values)
        self._keys[rows, 0] = missions.to(self._keys)
        self._keys[rows, 1] = step
        self._count = rows.stop

    def table(self) -> pd.DataFrame:
        """Return everything, ordered by mission and step."""
        import pandas as pd

        missions, steps = self._keys[: self._count].unbind(-1)
        order = torch.argsort(missions * (self._keys[: self._count, 1].max() + 1) + steps)
        frame = pd.DataFrame(self._values[: self._count][order].numpy(), columns=self.columns)
        frame.insert(0, "t", steps[order].int().numpy())
        frame.insert(0, "mission", missions[order].int().numpy())
        return frame.astype({name: "int32" for name in self.whole})

    def state_dict(self) -> dict[str, Tensor]:
        """Return all rows so far."""
        return {"values": self._values[: self._count], "keys": self._keys[: self._count]}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        self._count = len(state["keys"])
        spare = max(self._count, len(self._keys))
        self._values, self._keys = (
            torch.cat([rows, rows.new_empty(spare, rows.shape[-1])])
            for rows in (state["values"], state["keys"])
        )


def whole(agent: Agent) -> nn.ModuleDict:
    """Return all modules of an agent as one; a module that is shared has one name."""
    return nn.ModuleDict({k: getattr(agent, k) for k in ("model", "env", "planner", "updater")})


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


def snapshot(agent: Agent, loop: Loop) -> dict[str, Any]:
    """Return everything that the next steps and the tables depend on.

    That is the loop itself, the global generator, and of each module of the agent: all tensors
    (also those that are not persistent), its extra state as defined by ``nn.Module``, and the
    :class:`~afm_rl.streams.Streams` that it has under this name. Nothing else is saved.
    """
    return {
        "td": loop.td.to_dict(),
        "ids": loop.ids,
        "ends": loop.ends,
        "log": loop.log.state_dict(),
        "step": loop.step,
        "global": torch.random.get_rng_state(),
        "agent": {path: _read(module) for path, module in whole(agent).named_modules()},
    }


def restore(agent: Agent, loop: Loop, state: dict[str, Any]) -> None:
    """Put an agent and its loop, both at their start, where a :func:`snapshot` was taken."""
    for path, module in whole(agent).named_modules():
        _write(module, state["agent"][path], agent.device)
    torch.random.set_rng_state(state["global"])
    loop.log.load_state_dict(state["log"])
    loop.ids, loop.step = state["ids"].to(agent.device), state["step"]
    loop.ends = {name: part.to(agent.device) for name, part in state["ends"].items()}
    loop.td = TensorDict(state["td"], loop.ids.shape, device=loop.td.device)


def _read(module: nn.Module) -> dict[str, Any]:
    """Return the state of a module, without its parts."""
    state: dict[str, Any] = {**module._parameters, **module._buffers}
    if type(module).get_extra_state is not nn.Module.get_extra_state:
        state["extra"] = module.get_extra_state()
    if isinstance(module, MemoryHolder):
        state["memory"] = module.memory
    if isinstance(streams := getattr(module, "streams", None), Streams):
        state["streams"] = streams.state_dict()
    return {name: part for name, part in state.items() if part is not None}


def _write(module: nn.Module, state: Mapping[str, Any], device: torch.device) -> None:
    """Put a module where :func:`_read` was called."""
    for name in module._parameters.keys() & state:
        module.get_parameter(name).data = state[name].to(device)  # an optimiser knows it
    for name in module._buffers.keys() & state:
        setattr(module, name, state[name].to(device))
    if "extra" in state:
        module.set_extra_state(state["extra"])
    if isinstance(module, MemoryHolder):
        memory = state.get("memory")
        module.memory = memory and {name: field.to(device) for name, field in memory.items()}
    if "streams" in state:
        cast(Streams, module.streams).load_state_dict(state["streams"])


def leave(agent: Agent, loop: Loop, keep: Tensor) -> None:
    """Go on with the missions in ``keep`` only: the others are finished."""
    loop.ids, loop.td = loop.ids[keep], loop.td[keep]
    agent.model.select_(keep)
    agent.updater.follow()
    if agent.transform is not None:
        memory = agent.transform.memory
        agent.transform.hold({name: field[keep] for name, field in memory.items()})


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
