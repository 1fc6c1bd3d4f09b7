"""Time of a step of `ActionFlowWrapper` around robots of MuJoCo.

    python benchmarks/bench_wrapper.py
    python benchmarks/bench_wrapper.py --robots HalfCheetah go1 g1 --folder FOLDER

HalfCheetah acts at random, and all its motors are reversed; the walking robots have policies, and
one servo is reversed (`docs/howto/play.md` describes their folder). The times are medians and 99th
percentiles of the processor time of whole steps on one thread, with correction, exact model and
robot. Correcting: from the first step after the fault. Times grow on a busy machine, as does the
time of 1,000 additions ``x + x`` of small tensors: the last two columns are in units of it.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from timing import timed

from afm_rl import ActionFlowWrapper, FaultWrapper
from afm_rl.regimes.presets import Fault

sys.path[:0] = [str(Path(__file__).parent / "suites" / name) for name in ("zoo", "legged")]
from robot import OWN, Robot  # noqa: E402

LIMITS = {
    "HalfCheetah": ((1.6, 5.5), None),
    "go1": ((2.0, 8.0), None),
    "g1": ((2.5, 12.0), None),
}
"""Healthy and correcting, at most: in ms on a quiet machine; in times of 1,000 additions."""
Acting = Callable[[np.ndarray, dict[str, Any]], np.ndarray]


class Timed(FaultWrapper):
    """Sums the time (s) of the robot and its faulty actuators."""

    spent = 0.0

    def step(self, action: np.ndarray) -> tuple:
        begun = time.thread_time()
        answer = super().step(action)
        self.spent += time.thread_time() - begun
        return answer


def half_cheetah() -> tuple[Timed, Acting, Fault | str]:
    env = Timed(gymnasium.make("HalfCheetah-v5"))
    env.action_space.seed(0)
    return env, lambda *_: env.action_space.sample(), "all reversed"


def legged(folder: Path, name: str) -> tuple[Timed, Acting, Fault | str]:
    robot = Robot(folder if (folder / f"{name}.xml").is_file() else OWN, name)
    gait = robot.begin([0])

    def act(observation: np.ndarray, info: dict[str, Any]) -> np.ndarray:
        return gait(observation[None], info)[0]

    return Timed(robot.make(), home=robot.home, clip=False), act, robot.faults["one reversed"]


def measure(env: Timed, act: Acting, fault: Fault | str, steps: int) -> list[np.ndarray]:
    """Return the ms of each step, healthy and correcting: all of it, and the robot's ``(T, 2)``."""
    wrapper = ActionFlowWrapper(env)
    observation, info = wrapper.reset(seed=0)
    spent = []
    for part in ("none", fault):
        env.fail(part)
        rows = []
        for _ in range(steps):
            action, own = act(observation, info), env.spent
            begun = time.thread_time()
            observation, _, terminated, truncated, info = wrapper.step(action)
            rows.append((time.thread_time() - begun, env.spent - own))
            if terminated or truncated:
                break
        spent.append(1e3 * np.array(rows[1:] if part == "none" else rows))
    return spent


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="*", default=["HalfCheetah", "small"])
    parser.add_argument("--folder", type=Path, default=OWN, help="where walking robots are")
    parser.add_argument("--steps", type=int, default=200, help="healthy, and as many correcting")
    options = parser.parse_args()
    torch.set_num_threads(1)
    x = torch.ones(8)
    print(
        "a step:\n\n| | ms, p50 | p99 | robot | at most, quiet | 1,000 additions | at most |\n"
        "|---|---|---|---|---|---|---|"
    )
    for name in options.robots:
        robot = half_cheetah() if name == "HalfCheetah" else legged(options.folder, name)
        limits, relative = LIMITS.get(name, (None, None))
        spent = measure(*robot, options.steps)
        unit = np.median(timed({"": lambda: [x + x for _ in range(1000)]}, 9)[""])
        for k, (what, rows) in enumerate(zip(("healthy", "correcting"), spent, strict=True)):
            p50, p99 = np.quantile(rows[:, 0], [0.5, 0.99])
            most, times = (f"{limit[k]:.1f}" if limit else "" for limit in (limits, relative))
            print(
                f"| {name}, {what}, {len(rows)} steps | {p50:.2f} | {p99:.2f} | "
                f"{np.median(rows[:, 1]):.2f} | {most} | {p50 / unit:.2f} | {times} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
