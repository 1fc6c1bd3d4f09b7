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

from afm_rl.compiling.onnx_graph import as_onnx, load_runtime, trace
from afm_rl.errors import ConfigurationError, check_instance, refusing
from afm_rl.planning.icem import ICEM
from afm_rl.planning.mppi import MPPI
from afm_rl.planning.receding import SamplingPlanner
from afm_rl.storage.files import write_whole
from afm_rl.streams import Streams
from afm_rl.transforms.policy import ActionFlowPolicy

Draw = tuple[tuple[int, ...], float | None]
"""Shape and bound of normal numbers."""

OFF = 2.0  # first number of a memory while plans are executed as they are
RETURNED = ("next_memory", "executed_action")
MEANINGS = {
    "memory": "what is remembered; zeros begin a mission, then next_memory of the tick before; "
    "while its first number is 2, plans are executed as they are, with 1 they are corrected",
    "observation": "the state, as it was measured; not a number where there is no reading",
    "action": "the planned action, in the robot's units",
    "noise": "standard normal numbers, fresh ones at each tick, none beyond noise_bound",
    "next_memory": "the memory of the next tick",
    "executed_action": "what to send to the robot, in its units, within its limits",
}


class Controller(nn.Module):
    r"""A planner and its correction for one robot, as a pure function of tensors.

    .. math:: (m, s, g, \epsilon) \mapsto (m', a)

    All that is remembered is in m; a memory of zeros begins a mission, and, with the policy's
    ``keep_memory_on_reset``, one whose first number was set to -1 continues with what was learnt.
    While that number is 2, plans are executed as they are, and evidence is gathered on; 1 corrects
    again. A planner that samples takes standard normal numbers :math:`\epsilon`, fresh ones at each
    tick, none beyond :attr:`noise_bound`. Actions are those of planner and policy, up to rounding.

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
    ['memory', 'observation', 'goal', 'noise']
    >>> memory, noise = torch.zeros(controller.sizes["memory"]), controller.draw()
    >>> memory, action = controller(memory, torch.zeros(3), torch.ones(2), noise)
    >>> action.shape
    torch.Size([2])
    """

    start: Tensor

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
        kept = [*getattr(planner, "memory", ())]
        kept += [unravel_key((policy.prefix, "effect_bounds")), policy.memory_key]
        self.shapes = {key: first.get(key).shape for key in kept}
        begun = torch.cat([first.get(key).flatten() for key in kept])
        self.register_buffer("start", begun, persistent=False)
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
        """Find out which noise is asked for."""
        given = _Given(None)
        still = [torch.zeros(size).to(self.start) for size in self.task.values()]
        state, on = torch.zeros(self._states).to(self.start), torch.ones((), dtype=torch.bool)
        self._tick(self.start, state, on.to(state.device), still, given)
        self.draws = given.asked

    @property
    def _states(self) -> int:
        return self.policy.model.state_size

    @property
    def sizes(self) -> dict[str, int]:
        """Names of the arguments, in their order, and how many numbers each has."""
        names = {"-".join(k) if isinstance(k, tuple) else k: n for k, n in self.task.items()}
        sizes = {"memory": len(self.start) + 1, "observation": self._states, **names}
        noise = sum(math.prod(shape) for shape, _ in self.draws)
        return sizes | ({"noise": noise} if noise else {})

    @property
    def noise_bound(self) -> float:
        """The largest size of the noise, in standard deviations."""
        return min((math.inf if bound is None else bound for _, bound in self.draws), default=0.0)

    def draw(self) -> Tensor:
        """Draw the noise of one tick, as the planner would."""
        kind = self.start.dtype
        drawn = [self.streams.normal(s, bound=bound, dtype=kind) for s, bound in self.draws]
        return torch.cat([part.flatten() for part in drawn]) if drawn else self.start[:0]

    @torch.no_grad()
    def forward(self, memory: Tensor, observation: Tensor, *given: Tensor) -> tuple[Tensor, Tensor]:
        """Return the next memory, and the action to execute.

        Args:
            memory: m; zeros at first.
            observation: the state, ``(S,)``.
            given: the entries of the task, such as the goal, and the noise; see :attr:`sizes`.
        """
        task = given[: len(self.task)]
        before = torch.where(memory[:1] == 0.0, self.start, memory[1:])
        if self.policy.options["keep_memory_on_reset"]:
            before = torch.where(memory[:1] < 0.0, self._resumed(memory), before)
        noise = _Given(given[-1] if self.draws else None)
        on = memory[0] != OFF
        found, action = self._tick(before, observation, on, task, noise)
        return torch.cat([torch.where(on, 1.0, memory[:1]), found]), action

    def _resumed(self, memory: Tensor) -> Tensor:
        """Return what a mission begins with that keeps what was learnt."""
        size = math.prod(self.shapes[self.policy.memory_key])  # the last part
        nowhere = memory.new_full((self._states,), torch.nan)
        learnt = self.policy.corrector.resume(memory[-size:], nowhere)
        return torch.cat([self.start[:-size], learnt])

    def _tick(
        self,
        memory: Tensor,
        observation: Tensor,
        enabled: Tensor,
        task: Sequence[Tensor],
        noise: _Given,
    ) -> tuple[Tensor, Tensor]:
        td = TensorDict({self.policy.observation_key: observation})
        td.set(self.policy.enabled_key, enabled)
        td.update(dict(zip(self.task, task, strict=True)))
        parts = memory.split([math.prod(shape) for shape in self.shapes.values()])
        for (key, shape), part in zip(self.shapes.items(), parts, strict=True):
            td.set(key, part.view(shape))
        if self.planner is not None:
            if isinstance(self.planner, SamplingPlanner):
                self.planner.streams = noise
            self.planner(self.policy.arrival()(td))
        self.policy(td)
        later = td.get("next")
        return torch.cat([later.get(key).flatten() for key in self.shapes]), td.get(
            self.policy.action_key
        )


class _Given(Streams):
    """Numbers that were drawn before, in the place of a generator; notes what is asked for."""

    def __init__(self, numbers: Tensor | None) -> None:
        super().__init__()
        self.numbers, self.asked = numbers, list[Draw]()

    def normal(self, shape: tuple[int, ...], **given: Any) -> Tensor:
        """Return the next numbers; zeros where there are none."""
        used = sum(math.prod(size) for size, _ in self.asked)
        self.asked.append((shape, given.get("bound")))
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

    Its metadata names the arguments and their sizes (``memory:982 observation:3 ...``), what each
    means, and the bound of the noise. It takes a minute or two of one core.

    Args:
        controller: what to export, with weights and settings as they are now.
        path: the file.

    Returns:
        The SHA-256 of the file.

    Raises:
        ConfigurationError: where a package is missing, or a part cannot be exported.
    """
    path = check_exportable(path, controller.planner)
    example = [torch.zeros(n).to(controller.start) for n in controller.sizes.values()]
    about = {
        "arguments": " ".join(f"{name}:{size}" for name, size in controller.sizes.items()),
        "noise_bound": str(controller.noise_bound),
        "dtype": str(controller.start.dtype).removeprefix("torch."),
        "actions": str(controller.policy.action_spec.shape[-1]),
    }
    model = type(controller.policy.model).__name__
    refused = (
        f"export: planner, {model} or corrector decide by numbers or leave torch, so are no graph; "
        f"'afm-rl-export actuators={about['actions']} out=core.onnx' is the core, for any model"
    )
    with refusing(refused):
        names = [*controller.sizes]
        meanings = {name: MEANINGS.get(name, "entry of the task") for name in names}
        meanings |= {name: MEANINGS[name] for name in RETURNED}
        code = as_onnx(trace(controller, example), names, RETURNED, about | meanings)
    write_whole(path, code)
    return sha256(code).hexdigest()
