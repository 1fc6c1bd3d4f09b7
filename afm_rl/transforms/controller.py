"""Planner and correction as one function of tensors, which runs without this library."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from afm_rl.compiling.onnx_graph import as_onnx, load_runtime
from afm_rl.correction.base import Fields
from afm_rl.errors import ConfigurationError, check_instance, refusing
from afm_rl.planning.icem import ICEM
from afm_rl.planning.mppi import MPPI
from afm_rl.planning.receding import SamplingPlanner
from afm_rl.storage.files import write_whole
from afm_rl.streams import Streams
from afm_rl.transforms.policy import ActionFlowPolicy

Draw = tuple[tuple[int, ...], float | None]
"""Shape and bound of normal numbers."""

CORRECTED, OFF, RESUMED = 1.0, 2.0, -1.0  # modes of a mission; 0: it begins
ABOUT = {
    "memory": "what is remembered: zeros begin a mission, then next_memory of the tick before",
    "memory.mode": "0: a mission begins; -1: it begins with what was learnt; 1: plans are "
    "corrected; 2: plans are executed as they are",
    "observation": "the state, as it was measured; not a number where there is no reading",
    "action": "the planned action, in the robot's units",
    "noise": "standard normal numbers, fresh ones at each tick, none beyond noise_bound",
    "next_memory": "the memory of the next tick",
    "executed_action": "what to send to the robot, in its units, within its limits",
}


class Controller(nn.Module):
    r"""A planner and its correction for one robot, as a pure function of tensors.

    .. math:: (m, s, g, \epsilon) \mapsto (m', a)

    All that is remembered is in m, tensors by name; zeros begin a mission, and, with the policy's
    ``keep_memory_on_reset``, ``mode`` -1 begins it with what was learnt. While ``mode`` is 2, plans
    are executed as they are, and evidence is gathered; 1 corrects again. A planner that samples
    takes standard normal numbers :math:`\epsilon`, fresh ones at each tick, none beyond
    :attr:`noise_bound`. Actions are those of planner and policy, up to rounding.

    Args:
        planner: writes the planned action and, under ``next``, what it remembers. None: the
            planned action is given in the place of the task.
        policy: the correction.

    Raises:
        ConfigurationError: for a planner that cannot be taken.

    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
    >>> planner = MPPI(PlanningEnv(Dubins(), GoalDistance(), [-1.0, -1.5], [1.0, 1.5]))
    >>> controller = Controller(planner, ActionFlowPolicy(Dubins(), planner.action_spec))
    >>> list(controller.sizes)
    ['observation', 'goal', 'noise']
    >>> memory, noise = controller.empty(), controller.draw()
    >>> memory, action = controller(memory, torch.zeros(3), torch.ones(2), noise)
    >>> action.shape, memory["mode"]
    (torch.Size([2]), tensor([1.]))
    """

    def __init__(self, planner: TensorDictModuleBase | None, policy: ActionFlowPolicy) -> None:
        super().__init__()
        self.policy = check_instance("controller.policy", policy, ActionFlowPolicy)
        if policy.options["record"] is not None:
            raise ConfigurationError(
                "controller.policy: record=...: a controller is a pure function, which writes no "
                "file; give a policy without"
            )
        if policy.options["residual_steps"]:
            raise ConfigurationError(
                "controller.policy: residual_steps=...: a controller is a pure function, which "
                "fits no model; give a policy whose model is that of fit_residual"
            )
        self.planner, self.streams = copy.copy(planner), Streams()
        self.task: dict[NestedKey, int] = {policy.action_key: policy.action_spec.shape[-1]}
        first = policy.make_tensordict_primer()(TensorDict())
        if planner is not None:
            self.task = self._task_of(planner)
            if hasattr(planner, "make_tensordict_primer"):
                first = planner.make_tensordict_primer()(first)
        if isinstance(planner, SamplingPlanner):
            self.streams = planner.streams
        memory = first.get(policy.memory_key)
        keys = [*getattr(planner, "memory", ()), unravel_key((policy.prefix, "effect_bounds"))]
        self.keys = {_named(key): key for key in keys}
        self.keys |= {
            f"afm.{name}": unravel_key((policy.memory_key, name)) for name in memory.keys()
        }
        for name, key in self.keys.items():  # what a mission begins with
            self.register_buffer(_buffer(name), first.get(key).clone(), persistent=False)
        self.draws: list[Draw] = []
        self._record()

    def _task_of(self, planner: Any) -> dict[NestedKey, int]:
        """Return the entries that the planner reads beside the state, and their sizes."""
        env = getattr(planner, "env", None)
        if env is None or tuple(planner.out_keys[:1]) != (self.policy.action_key,):
            raise ConfigurationError(
                f"controller.planner={type(planner).__name__}: expected a planner with an `env` "
                f"that writes {self.policy.action_key!r}"
            )
        entries = env.observation_spec.items(True, True)
        states = (self.policy.observation_key, unravel_key((self.policy.prefix, "arrival")))
        return {key: s.shape[-1] for key, s in entries if key not in states}

    def _record(self) -> None:
        """Find out which noise the planner draws."""
        noise = _Given(None)
        still = [torch.zeros(size).to(self._like) for size in self.task.values()]
        state, on = torch.zeros(self._states).to(self._like), torch.ones((), dtype=torch.bool)
        self._tick(self.start, state, on.to(state.device), still, noise)
        self.draws = noise.draws

    @property
    def start(self) -> Fields:
        """What a mission begins with, by name, without the mode."""
        return {name: self.get_buffer(_buffer(name)) for name in self.keys}

    @property
    def _like(self) -> Tensor:
        return self.get_buffer(_buffer("afm.state"))

    def empty(self) -> Fields:
        """Return the memory of zeros, by name, by which a mission begins."""
        zeros = {name: torch.zeros_like(field) for name, field in self.start.items()}
        return {"mode": self._like.new_zeros(1), **zeros}

    @property
    def _states(self) -> int:
        return self.policy.model.state_size

    @property
    def sizes(self) -> dict[str, int]:
        """Names of the arguments after the memory, and how many numbers each has."""
        sizes = {"observation": self._states} | {_named(k): n for k, n in self.task.items()}
        noise = sum(math.prod(shape) for shape, _ in self.draws)
        return sizes | ({"noise": noise} if noise else {})

    @property
    def noise_bound(self) -> float:
        """The largest size of the noise, in standard deviations."""
        return min((math.inf if bound is None else bound for _, bound in self.draws), default=0.0)

    def draw(self) -> Tensor:
        """Draw the noise of one tick, as the planner would."""
        kind = self._like.dtype
        drawn = [self.streams.normal(s, bound=bound, dtype=kind) for s, bound in self.draws]
        return torch.cat([part.flatten() for part in drawn]) if drawn else self._like[:0]

    @torch.no_grad()
    def forward(self, memory: Fields, observation: Tensor, *given: Tensor) -> tuple[Fields, Tensor]:
        """Return the next memory, and the action to execute.

        Args:
            memory: m, by name; :meth:`empty` at first.
            observation: the state, ``(S,)``.
            given: the entries of the task, such as the goal, and the noise; see :attr:`sizes`.
        """
        task, mode = given[: len(self.task)], memory["mode"]
        noise, on = _Given(given[-1] if self.draws else None), mode[0] != OFF
        before = {
            name: torch.where(mode[0] == 0.0, begun, memory[name])
            for name, begun in self.start.items()
        }
        if self.policy.options["keep_memory_on_reset"]:
            resumed = self._resumed(memory)
            before = {
                name: torch.where(mode[0] < 0.0, resumed[name], field)
                for name, field in before.items()
            }
        later, action = self._tick(before, observation, on, task, noise)
        return {"mode": torch.where(on, CORRECTED, mode), **later}, action

    def _resumed(self, memory: Fields) -> Fields:
        """Return what a mission begins with that keeps what was learnt."""
        policy, nowhere = self.policy, self._like.new_full((self._states,), torch.nan)
        learnt = {
            name.removeprefix("afm."): memory[name] for name in self.keys if name.startswith("afm.")
        }
        learnt = policy.corrector.resume(learnt, nowhere, policy.model)
        return self.start | {f"afm.{name}": field for name, field in learnt.items()}

    def _tick(
        self,
        memory: Fields,
        observation: Tensor,
        enabled: Tensor,
        task: Sequence[Tensor],
        noise: _Given,
    ) -> tuple[Fields, Tensor]:
        td = TensorDict({self.policy.observation_key: observation})
        td.set(self.policy.enabled_key, enabled)
        td.update(dict(zip(self.task, task, strict=True)))
        for name, key in self.keys.items():
            td.set(key, memory[name])
        if self.planner is not None:
            if isinstance(self.planner, SamplingPlanner):
                self.planner.streams = noise
            self.planner(self.policy.arrival()(td))
        self.policy(td)
        later = td.get("next")
        found = {name: later.get(key) for name, key in self.keys.items()}
        return found, td.get(self.policy.action_key)


def _named(key: NestedKey) -> str:
    return "-".join(key) if isinstance(key, tuple) else key


def _buffer(name: str) -> str:
    return f"start_{name}".replace(".", "_")


class Exported(nn.Module):
    """A controller as a function of one argument after the other, as graphs are.

    Args:
        controller: which it is; fields without numbers are left out.
    """

    def __init__(self, controller: Controller) -> None:
        super().__init__()
        self.controller, self.memory = controller, controller.empty()
        self.names = [name for name, field in self.memory.items() if field.numel()]
        sizes = controller.sizes.items()
        self.inputs = {f"memory.{name}": self.memory[name] for name in self.names}
        self.inputs |= {name: torch.zeros(size).to(controller._like) for name, size in sizes}
        self.outputs = [*(f"next_memory.{name}" for name in self.names), "executed_action"]

    def forward(self, *given: Tensor) -> list[Tensor]:
        """Return the fields of the next memory, and the action to execute."""
        fields = dict(zip(self.names, given, strict=False))
        memory, action = self.controller(self.memory | fields, *given[len(fields) :])
        # A graph returns none of its inputs: what is handed on is copied.
        return [*(1.0 * memory[name] for name in self.names), action]


class _Given(Streams):
    """Numbers that were drawn before, in the place of a generator; notes what is drawn."""

    def __init__(self, numbers: Tensor | None) -> None:
        super().__init__()
        self.numbers, self.draws = numbers, list[Draw]()

    def normal(self, shape: tuple[int, ...], **given: Any) -> Tensor:
        """Return the next numbers; zeros where there are none."""
        used = sum(math.prod(size) for size, _ in self.draws)
        self.draws.append((shape, given.get("bound")))
        if self.numbers is None:
            return torch.zeros(shape, dtype=given.get("dtype"))
        return self.numbers[used : used + math.prod(shape)].view(shape).clone()


def check_exportable(path: str | Path, planner: Any = None) -> Path:
    """Return the file to export to.

    Args:
        path: the file.
        planner: that is to be exported, if there is one.

    Raises:
        ConfigurationError: if it cannot be written, or there is nothing to write it with.
    """
    path = Path(path)
    if path.suffix != ".onnx" or not path.parent.is_dir():
        raise ConfigurationError(f"out={path}: expected a file NAME.onnx in a folder that exists")
    load_runtime()
    if not isinstance(planner, MPPI | ICEM | None):
        raise ConfigurationError(
            f"out={path.name}: {type(planner).__name__} cannot be written as ONNX; expected "
            "MPPI or ICEM, or planner=null for the correction alone"
        )
    return path


def export_controller(controller: Controller, path: str | Path) -> str:
    """Write a controller as an ONNX graph, which runs without this library and without torch.

    Inputs are the fields of the memory, ``memory.NAME``, the observation, entries of the task, and
    the noise; outputs are ``next_memory.NAME`` and ``executed_action``. Its metadata say what each
    is, and the bound of the noise. It takes a minute or two of one core.

    Args:
        controller: what to export, with weights and settings as they are now.
        path: the file.

    Returns:
        The SHA-256 of the file.

    Raises:
        ConfigurationError: where a package is missing, or a part cannot be exported.
    """
    path = check_exportable(path, controller.planner)
    graph = Exported(controller)
    shapes = {name: "x".join(map(str, x.shape)) for name, x in graph.inputs.items()}
    about = {
        "arguments": " ".join(f"{name}:{shape}" for name, shape in shapes.items()),
        "dtype": str(controller._like.dtype).removeprefix("torch."),
        "noise_bound": str(controller.noise_bound),
        "actions": str(controller.policy.action_spec.shape[-1]),
    }
    model = type(controller.policy.model).__name__
    refused = (
        f"export: planner, {model} or corrector decide by numbers or leave torch, so are no graph; "
        f"'afm-rl-export actuators={about['actions']} out=core.onnx' is the core, for any model"
    )
    with refusing(refused):
        task = dict.fromkeys(controller.sizes, "entry of the task")
        fields = {name: "a field of the memory" for name in (*graph.inputs, *graph.outputs)}
        code = as_onnx(graph, graph.inputs, graph.outputs, fields | task | ABOUT | about)
    write_whole(path, code)
    return sha256(code).hexdigest()
