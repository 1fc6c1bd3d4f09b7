"""Transitions to learn from, made by any policy in any environment."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase

from afm_rl.errors import check_count
from afm_rl.spaces.keys import as_keys

TRANSITION = ("observation", "action", ("next", "observation"))
"""Where state, action and next state are."""


def collect(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase] | None = None,
    frames: int = 1000,
    *,
    keys: Sequence[NestedKey] = (*TRANSITION, ("next", "reward"), ("next", "done")),
    seed: int = 0,
) -> TensorDictReplayBuffer:
    """Run a policy and store every transition in a replay buffer.

    Uses a TorchRL ``Collector`` once. Episodes that end are reset; the next state of their last
    step is the true terminal state. The environment stays open.

    Args:
        env: any TorchRL environment, batched or not; it is seeded.
        policy: a planner, for example, whose transforms ``env`` has; random actions if None.
        frames: number of transitions, rounded up to whole steps of the batch.
        keys: entries that are kept.
        seed: seed of the environment and of random actions; the global generator does not change.

    >>> from torchrl.envs import GymEnv
    >>> buffer = collect(GymEnv("Pendulum-v1"), frames=300)
    >>> buffer[:].get(("next", "observation")).shape
    torch.Size([300, 3])
    """
    from torchrl.collectors import Collector  # slow to import, and seldom needed

    batch = env.batch_size.numel()
    total = batch * math.ceil(check_count("frames", frames) / batch)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        env.set_seed(seed)
        collector = Collector(
            env,
            policy,
            frames_per_batch=total,
            total_frames=total,
            use_buffers=False,  # to fill them it would ask the policy once beforehand
            trust_policy=True,
            auto_register_policy_transforms=False,
        )
        try:
            data = next(iter(collector))
        finally:
            collector.shutdown(close_env=False)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(total), batch_size=min(256, total))
    buffer.extend(data.select(*as_keys(keys)).reshape(-1))
    return buffer
