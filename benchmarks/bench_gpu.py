"""Many missions on a GPU: agreement with the processor, and times.

    python benchmarks/bench_gpu.py

A step of each mission plans (MPPI, horizon 5), corrects (AFM) and moves a ground robot whose motors
are reversed. First a few missions run on the processor and on the device, in double precision, and
the executed actions must agree. Then it prints the times (ms, medians) of planner and tick, and the
share of the correction in a step that plans and corrects. It ends within five minutes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from statistics import median

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp

from afm_rl.compiling.devices import check_device
from afm_rl.dynamics import Dubins
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
from afm_rl.transforms import ActionFlowPolicy

SECONDS, TOLERANCE = 300.0, 1e-5
LOW, HIGH = [-1.0, -1.57], [1.0, 1.57]


class Missions:
    """Missions side by side on a device, whose motors have a gain."""

    def __init__(
        self, missions: int, candidates: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        box = [torch.tensor(end, dtype=dtype, device=device) for end in (LOW, HIGH)]
        self.model = Dubins().to(device)
        world = PlanningEnv(self.model, GoalDistance(), *box)
        self.planner = MPPI(world, horizon=5, candidates=candidates, seed_key="seed").to(device)
        self.policy = ActionFlowPolicy(self.model, self.planner.action_spec).to(device)
        start = torch.linspace(0, 1, missions, dtype=dtype, device=device).unsqueeze(-1)
        td: TensorDictBase = TensorDict(
            {
                "observation": start * torch.ones(3, dtype=dtype, device=device),
                "goal": torch.full((missions, 2), 1e3, dtype=dtype, device=device),
                "seed": torch.arange(missions, device=device),
            },
            [missions],
            device=device,
        )
        for part in (self.planner, self.policy):
            td = part.make_tensordict_primer()(td)
        self.td, self.device = td, device

    def plan(self) -> None:
        self.td = self.planner(self.td)

    def correct(self) -> None:
        self.td = self.policy(self.td)

    def move(self, gain: float) -> Tensor:
        """Advance by a step; return the executed actions, ``(N, A)``."""
        action = self.td["action"]
        self.td["next", "observation"] = self.model(self.td["observation"], gain * action)
        same = {name: self.td[name] for name in ("goal", "seed")}
        self.td = step_mdp(self.td).update(same)
        return action

    def timed(self, work: Callable[[], None]) -> float:
        """Return the ms until the device has finished some work."""
        self._wait()
        begun = time.perf_counter()
        work()
        self._wait()
        return 1e3 * (time.perf_counter() - begun)

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


@torch.no_grad()
def largest_difference(device: torch.device, missions: int = 4, steps: int = 12) -> float:
    """Return the largest difference between actions of the device and of the processor."""
    both = [Missions(missions, 64, place, torch.float64) for place in (torch.device("cpu"), device)]
    largest = 0.0
    for _ in range(steps):
        found = []
        for batch in both:
            batch.plan()
            batch.correct()
            found.append(batch.move(-0.8).cpu())
        largest = max(largest, float((found[0] - found[1]).abs().max()))
    return largest


@torch.no_grad()
def measure(
    missions: int, candidates: int, device: torch.device, rounds: int, end: float
) -> tuple[list[float], list[float], list[float]]:
    """Return the ms of plans, and of silent and correcting ticks, until ``end`` at the latest."""
    batch = Missions(missions, candidates, device, torch.float32)
    plans: list[float] = []
    ticks: dict[float, list[float]] = {1.0: [], -0.8: []}
    for gain, spent in ticks.items():
        for turn in range(rounds + 5):  # the first ones are not counted
            planned, corrected = batch.timed(batch.plan), batch.timed(batch.correct)
            batch.move(gain)
            if turn >= 5 or time.monotonic() > end:
                plans.append(planned)
                spent.append(corrected)
            if time.monotonic() > end:
                break
    return plans, ticks[1.0], ticks[-0.8]


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--missions", type=int, nargs="+", default=[1, 64, 512, 4096])
    parser.add_argument("--candidates", type=int, default=4096, help="of each mission")
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args()
    device, end = check_device("--device", options.device), time.monotonic() + SECONDS
    cuda = device.type == "cuda"
    card = torch.cuda.get_device_name(device) if cuda else "processor, one thread"
    torch.set_num_threads(1)
    difference = largest_difference(device)
    if not difference <= TOLERANCE:
        raise SystemExit(f"actions differ by {difference:.1e} from those of the processor")
    print(f"largest difference of actions from those of the processor: {difference:.1e}\n")
    print(
        f"times in ms:\n\n| {card}: missions of {options.candidates} candidates | plan | "
        "tick, silent | correcting | correcting, a mission | share of a step |\n"
        f"|---|{'---|' * 5}"
    )
    for missions in options.missions:
        if time.monotonic() > end:
            print(f"| {missions} | not measured: five minutes are over | | | | |")
            continue
        spent = measure(missions, options.candidates, device, options.rounds, end)
        plan, silent, correcting = map(median, spent)
        share = correcting / (plan + correcting)
        print(
            f"| {missions} | {plan:.2f} | {silent:.2f} | {correcting:.2f} | "
            f"{correcting / missions:.4f} | {share:.1%} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
