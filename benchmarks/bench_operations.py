"""Number of tensor operations in a step of the loop: core, effective action, and the rest.

    python benchmarks/bench_operations.py
    python benchmarks/bench_operations.py --by function --top 20

The count is that of PyTorch's dispatcher, with views: each operation takes about 5 us, whatever its
size. An operation counts for the innermost file (or function) of the library that calls it, and an
operation that reads a value (`compiling`) for the caller. Silent: a healthy robot; correcting: from
the first step after all its motors were reversed; 40 steps each.
`bench_wrapper.py` has the times of a step.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from statistics import median
from types import FrameType
from typing import Any

import gymnasium
import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.data import Bounded

from afm_rl import ActionFlowWrapper
from afm_rl.dynamics import Dubins
from afm_rl.transforms import CorrectionLoop

STEPS, WARM_UP = 40, 10
LIBRARY = str(Path(sys.modules["afm_rl"].__file__).parent) + "/"
CORE = ("core", "belief", "decide", "regression", "table", "records", "achievable")
PARTS = {
    "core": tuple(f"correction/{name}.py" for name in CORE),
    "effective action and model": ("dynamics/", "spaces/"),
    "robot": ("robot",),
    "around them": ("",),
}
"""Files whose operations are counted together, by how their names begin."""


class Operations(TorchDispatchMode):
    """Counts operations by the part of the library that calls them."""

    def __init__(self, by_function: bool) -> None:
        super().__init__()
        self.by_function, self.parts = by_function, Counter[str]()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.parts[self._part(sys._getframe(1))] += 1
        return func(*args, **(kwargs or {}))

    def _part(self, frame: FrameType | None) -> str:
        while frame is not None:
            file = frame.f_code.co_filename
            if file.startswith(LIBRARY) and not file.startswith(f"{LIBRARY}compiling/"):
                break
            frame = frame.f_back
        if frame is None:
            return "robot"
        file = frame.f_code.co_filename.removeprefix(LIBRARY)
        return f"{file}: {frame.f_code.co_qualname}" if self.by_function else file


def ground_robot() -> Callable[[float], None]:
    """Return a step of a Dubins car whose motors have a gain."""
    spec = Bounded(torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5]))
    model, state = Dubins(), torch.zeros(3)
    loop = CorrectionLoop("benchmark").complete(model, spec)
    (memory, _), random = loop.begin(state, spec), np.random.default_rng(0)

    def step(gain: float) -> None:
        nonlocal memory, state
        planned = torch.as_tensor(random.uniform(-1, 1, 2), dtype=torch.float32)
        memory, record = loop.act(memory, planned, spec)
        state = model(state, gain * record.executed_action)
        memory = loop.observe(memory, state)

    return step


class Motors(gymnasium.ActionWrapper):
    """Motors with a gain."""

    gain = 1.0

    def action(self, action: np.ndarray) -> np.ndarray:
        return self.gain * action


def half_cheetah() -> Callable[[float], None]:
    """Return a step of HalfCheetah behind the wrapper with its defaults."""
    motors = Motors(gymnasium.make("HalfCheetah-v5"))
    env = ActionFlowWrapper(motors)
    env.reset(seed=0)
    env.action_space.seed(0)

    def step(gain: float) -> None:
        motors.gain = gain
        env.step(env.action_space.sample())

    return step


ROBOTS = {"ground robot": ground_robot, "HalfCheetah": half_cheetah}


def counted(step: Callable[[], None], by_function: bool) -> list[Counter[str]]:
    """Return the operations of some steps, by part."""
    counts = []
    for _ in range(STEPS):
        with Operations(by_function) as operations:
            step()
        counts.append(operations.parts)
    return counts


def main() -> None:
    """Print two tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--by", choices=["file", "function"], default="file")
    parser.add_argument("--top", type=int, default=100, help="parts to print")
    options = parser.parse_args()
    torch.set_num_threads(1)
    parts: dict[str, list[Counter[str]]] = {}
    print(f"| operations of a step, median | {' | '.join(PARTS)} | all |\n|---|{'---|' * 5}")
    for robot, make in ROBOTS.items():
        step = make()
        for _ in range(WARM_UP):
            step(1.0)
        for what, gain in {"silent": 1.0, "correcting": -1.0}.items():
            name = f"{robot}, {what}"
            parts[name] = counted(lambda: step(gain), options.by == "function")  # noqa: B023
            sums = [Counter[str]() for _ in parts[name]]
            for of_step, total in zip(parts[name], sums, strict=True):
                for file, count in of_step.items():
                    total[next(k for k, heads in PARTS.items() if file.startswith(heads))] += count
            medians = [median(total[part] for total in sums) for part in PARTS]
            numbers = [*medians, median(total.total() for total in sums)]
            print(f"| {name} | {' | '.join(f'{number:.0f}' for number in numbers)} |")
    table = {
        part: [median(count[part] for count in counts) for counts in parts.values()]
        for part in {part: None for counts in parts.values() for count in counts for part in count}
    }
    print(f"\n| median, by {options.by} | {' | '.join(parts)} |\n|---|{'---|' * len(parts)}")
    for part in sorted(table, key=lambda part: -max(table[part]))[: options.top]:
        print(f"| {part} | {' | '.join(f'{number:.0f}' for number in table[part])} |")


if __name__ == "__main__":
    main()
