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
Policy = Callable[..., Sequence[np.ndarray]]


class Agent:
    """A policy and its memory.

    Args:
        policy: (memory, state, goal, noise) -> (memory, action), of arrays.
        sizes: how many numbers each of these has.
        noise_bound: the largest noise, in standard deviations.
        kind: of all its numbers, float32 or float64.
    """

    def __init__(
        self, policy: Policy, sizes: dict[str, int], noise_bound: float, kind: str = "float32"
    ) -> None:
        self.policy, self.sizes, self.bound, self.kind = policy, sizes, noise_bound, kind
        self.random = np.random.default_rng()
        self.begin()

    def begin(self) -> None:
        """Forget everything: a memory of zeros begins a mission."""
        self.memory = np.zeros(self.sizes["memory"], self.kind)

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
        if "noise" in self.sizes:
            given.append(self._noise().astype(self.kind))
        self.memory, action = self.policy(self.memory, *given)
        return action.tolist()

    def _noise(self) -> np.ndarray:
        numbers = self.random.standard_normal(self.sizes["noise"])
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
        policy, about = graph(code)
        sizes = {name: int(n) for name, n in (s.rsplit(":", 1) for s in about["arguments"].split())}
        return Agent(policy, sizes, float(about["noise_bound"]), about["dtype"])
    except Exception as error:  # each runtime has its own; another's file lacks entries
        why = " ".join(str(error).split())[:200]
        raise SystemExit(
            f"{path}: no file of afm-rl-export that runs here ({type(error).__name__}: {why})"
        ) from error


def graph(code: bytes) -> tuple[Policy, dict[str, str]]:
    """Return the function of an ONNX file, and its metadata."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # the work is many small steps
    session = onnxruntime.InferenceSession(code, options, providers=["CPUExecutionProvider"])
    names = [entry.name for entry in session.get_inputs()]
    about = session.get_modelmeta().custom_metadata_map
    return lambda *given: session.run(None, dict(zip(names, given, strict=True))), about


def of_tensors(function: Callable[..., Any]) -> Policy:
    """Return a function of tensors as one of arrays."""
    import torch

    torch.set_num_threads(1)

    @torch.no_grad()
    def policy(*given: np.ndarray) -> list[np.ndarray]:
        return [found.numpy() for found in function(*map(torch.from_numpy, given))]

    return policy


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
    planner = MPPI(world, box_key=("afm", "effect_bounds"))
    controller = Controller(planner, ActionFlowPolicy(model, planner.action_spec))
    return Agent(of_tensors(controller), controller.sizes, controller.noise_bound)
