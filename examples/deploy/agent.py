"""A policy with its memory: states go in, actions come out."""

from __future__ import annotations

import hashlib
import io
import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

STATES = 3  # x (m), y (m), heading (rad)
Policy = Callable[..., tuple[Tensor, Tensor]]


class Agent:
    """A policy and its memory.

    Args:
        policy: (memory, state, goal, noise) -> (memory, action).
        sizes: how many numbers each of these has.
        noise_bound: the largest noise, in standard deviations.
        kind: of all its numbers.
    """

    def __init__(
        self, policy: Policy, sizes: dict[str, int], noise_bound: float, kind: torch.dtype
    ) -> None:
        self.policy, self.sizes, self.bound, self.kind = policy, sizes, noise_bound, kind
        self.memory = torch.zeros(sizes["memory"], dtype=kind)  # a memory of zeros begins a mission

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

    @torch.no_grad()
    def _tick(self, state: Sequence[float], goal: Sequence[float]) -> list[float]:
        given = [torch.tensor(numbers, dtype=self.kind) for numbers in (state, goal)]
        if "noise" in self.sizes:
            noise = torch.empty(self.sizes["noise"], dtype=self.kind)
            given.append(torch.nn.init.trunc_normal_(noise, a=-self.bound, b=self.bound))
        self.memory, action = self.policy(self.memory, *given)
        return action.tolist()


def load(path: str, sha256: str | None) -> Agent:
    """Return what ``afm-rl-export`` wrote, if it is that; it needs torch alone.

    The file is a program. Only the bytes whose checksum was asked for are loaded.
    """
    code = Path(path).read_bytes()
    found = hashlib.sha256(code).hexdigest()
    if found != sha256:
        raise SystemExit(
            f"{path}: its sha256 is {found}, expected {sha256}; give --sha256 as afm-rl-export "
            "printed it"
        )
    policy = torch._inductor.aoti_load_package(io.BytesIO(code))
    about = policy.loader.get_metadata()
    sizes = {name: int(n) for name, n in (s.rsplit(":", 1) for s in about["arguments"].split())}
    return Agent(policy, sizes, float(about["noise_bound"]), getattr(torch, about["dtype"]))


def make() -> Agent:
    """Return MPPI over the nominal physics, and the correction."""
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
    return Agent(controller, controller.sizes, controller.noise_bound, torch.float32)
