"""What the correction adds to rollouts of TorchRL and to a mission alone, each beside its limit.

    python benchmarks/bench_rollout.py

Rollouts of healthy robots with `ActionFlowTransform`, against the bare environment, in turns within
one run, so that the ratios hold when the machine's speed drifts; and a step of one mission as
`afm-rl` makes it. Processor time of one thread, medians.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import torch
from hydra import compose, initialize_config_module
from timing import timed
from torch import Tensor
from torchrl.envs import EnvBase, GymEnv, TransformedEnv

from afm_rl.dynamics import Dubins, DynamicsModel, KnownDynamics
from afm_rl.envs import UGVTrack
from afm_rl.missions import build, prepare, run
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform

STEPS, ROUNDS = 200, 7


def swing(state: Tensor, torque: Tensor) -> Tensor:
    """Return the next observation of Pendulum-v1: cosine, sine, and speed (rad/s)."""
    cosine, sine, speed = state.unbind(-1)
    faster = speed + (15.0 * sine + 3.0 * torque.squeeze(-1).clamp(-2.0, 2.0)) * 0.05
    faster = faster.clamp(-8.0, 8.0)
    angle = torch.atan2(sine, cosine) + 0.05 * faster
    return torch.stack([angle.cos(), angle.sin(), faster], -1)


def pendulum() -> tuple[EnvBase, DynamicsModel]:
    return GymEnv("Pendulum-v1"), KnownDynamics(swing, Manifold(3), 1)


def ground_robot() -> tuple[EnvBase, DynamicsModel]:
    return UGVTrack(batch_size=()), Dubins()


def ratio(make: Callable[[], tuple[EnvBase, DynamicsModel]]) -> tuple[float, float]:
    """Return the ms of a corrected step, and how many times that of a bare one it is."""
    env, model = make()
    corrected = TransformedEnv(make()[0], ActionFlowTransform(model))
    jobs = {"bare": env, "corrected": corrected}
    rollouts = {
        name: lambda one=one: one.rollout(STEPS, break_when_any_done=False)
        for name, one in jobs.items()
    }
    spent = timed(rollouts, ROUNDS, warm_up=1, clock=time.thread_time)
    ratios = [b / a for a, b in zip(spent["bare"], spent["corrected"], strict=True)]
    return median(spent["corrected"]) / STEPS, median(ratios)


def mission(method: str) -> float:
    """Return the ms of a step of one mission: that of many steps less that of few."""
    spent = []
    for budget in (10, 60):
        with initialize_config_module("afm_rl.conf", version_base="1.3"):
            agent = build(compose("config", [f"method={method}", f"budget={budget}"]))
        prepare(agent, "outputs/cache")  # physics needs no training
        begun = time.thread_time()
        run(agent)
        spent.append(time.thread_time() - begun)
    return 1e3 * (spent[1] - spent[0]) / 50


def main() -> None:
    """Print a table."""
    torch.set_num_threads(1)
    print("| | ms a step | times the bare environment | at most |\n|---|---|---|---|")
    for name, make, most in (("Pendulum", pendulum, 3.0), ("UGV", ground_robot, 1.8)):
        ms, times = ratio(make)
        print(f"| {name} | {ms:.2f} | {times:.2f} | {most} times |", flush=True)
    for method, limit in (("physics", 3.0), ("afm_physics", 7.0)):
        ms = median(mission(method) for _ in range(3))
        print(f"| a mission, {method} | {ms:.2f} | | {limit} ms, quiet |", flush=True)


if __name__ == "__main__":
    main()
