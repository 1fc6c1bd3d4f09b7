"""A policy with its memory: states go in, actions come out."""

from __future__ import annotations

import hashlib
import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

STATES = 3  # x (m), y (m), heading (rad)
Memory = dict[str, np.ndarray]
Policy = Callable[..., tuple[Memory, np.ndarray]]


class Agent:
    """A policy and its memory.

    Args:
        policy: (memory, state, goal, noise) -> (memory, action); the memory by name, all of arrays.
        empty: the memory that begins a mission.
        noise: how many random numbers a tick needs.
        noise_bound: the largest of them, in standard deviations.
    """

    def __init__(self, policy: Policy, empty: Memory, noise: int, noise_bound: float) -> None:
        self.policy, self.empty, self.noise, self.bound = policy, empty, noise, noise_bound
        self.kind = empty["mode"].dtype
        self.random = np.random.default_rng()
        self.begin()

    def begin(self) -> None:
        """Forget everything: a memory of zeros begins a mission."""
        self.memory = self.empty

    def act(self, state: Sequence[float], goal: Sequence[float], follows: bool) -> list[float]:
        """Return the action to execute.

        Args:
            state: as it was measured.
            goal: of the task.
            follows: whether the last action, and nothing else, led to this state; if not, the
                transition is not remembered.
        """
        if not follows:
            self._tick([math.nan] * len(state), goal)
        return self._tick(state, goal)

    def _tick(self, state: Sequence[float], goal: Sequence[float]) -> list[float]:
        given = [np.array(numbers, self.kind) for numbers in (state, goal)]
        if self.noise:
            given.append(self._noise().astype(self.kind))
        self.memory, action = self.policy(self.memory, *given)
        return action.tolist()

    def _noise(self) -> np.ndarray:
        numbers = self.random.standard_normal(self.noise)
        while (far := np.abs(numbers) > self.bound).any():
            numbers[far] = self.random.standard_normal(far.sum())
        return numbers


def load(path: str | Path, sha256: str | None) -> Agent:
    """Return what ``afm-rl-export`` wrote, if it is that.

    It needs onnxruntime and NumPy. Only the bytes whose checksum was asked for are loaded.
    """
    code = Path(path).read_bytes()
    found = hashlib.sha256(code).hexdigest()
    if found != sha256:
        raise SystemExit(
            f"{path}: its sha256 is {found}, expected {sha256}; give --sha256 as afm-rl-export "
            "printed it"
        )
    try:
        return graph(code)
    except Exception as error:  # each runtime has its own; another's file lacks entries
        why = " ".join(str(error).split())[:200]
        raise SystemExit(
            f"{path}: no file of afm-rl-export that runs here ({type(error).__name__}: {why})"
        ) from error


def graph(code: bytes) -> Agent:
    """Return the agent of an ONNX file."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # the work is many small steps
    session = onnxruntime.InferenceSession(code, options, providers=["CPUExecutionProvider"])
    about = session.get_modelmeta().custom_metadata_map
    inputs = {entry.name: entry for entry in session.get_inputs()}
    kinds = {"tensor(float)": "float32", "tensor(double)": "float64"}
    empty = {
        name.removeprefix("memory."): np.zeros(entry.shape, kinds[entry.type])
        for name, entry in inputs.items()
        if name.startswith("memory.")
    }
    others = [name for name in inputs if not name.startswith("memory.")]

    def policy(memory: Memory, *given: np.ndarray) -> tuple[Memory, np.ndarray]:
        named = {f"memory.{name}": field for name, field in memory.items()}
        *later, action = session.run(None, named | dict(zip(others, given, strict=True)))
        return dict(zip(memory, later, strict=True)), action

    noise = inputs["noise"].shape[0] if "noise" in inputs else 0
    return Agent(policy, empty, noise, float(about["noise_bound"]))


def of_tensors(controller: Any) -> Agent:
    """Return the agent of a controller in torch."""
    import torch

    torch.set_num_threads(1)

    @torch.no_grad()
    def policy(memory: Memory, *given: np.ndarray) -> tuple[Memory, np.ndarray]:
        fields = {name: torch.from_numpy(field) for name, field in memory.items()}
        later, action = controller(fields, *map(torch.from_numpy, given))
        return {name: field.numpy() for name, field in later.items()}, action.numpy()

    empty = {name: field.numpy() for name, field in controller.empty().items()}
    return Agent(policy, empty, controller.sizes.get("noise", 0), controller.noise_bound)


def make() -> Agent:
    """Return MPPI over the nominal physics, and the correction."""
    import torch

    from afm_rl.dynamics import Dubins
    from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
    from afm_rl.transforms import ActionFlowPolicy
    from afm_rl.transforms.controller import Controller

    # The planner is shown a state of NaN after a gap, and remarks on it.
    warnings.filterwarnings("ignore", "planner: no finite return")
    model, low, high = Dubins(), torch.tensor([-1.0, -1.57]), torch.tensor([1.0, 1.57])
    world = PlanningEnv(model, GoalDistance(), low, high)
    planner = MPPI(world, bounds_key=("afm", "effect_bounds"))
    return of_tensors(Controller(planner, ActionFlowPolicy(model, planner.action_spec)))
