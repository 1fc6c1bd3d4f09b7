"""Any policy as a function of a batch of observations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from afm_rl.comparison.robot import EnvRobot, Robot
from afm_rl.errors import ConfigurationError, refusing
from afm_rl.planning import load_policy, policy_from_onnx, policy_from_sb3

Acting = Callable[[np.ndarray, dict[str, Any]], np.ndarray]
"""Returns actions ``(N, A)`` for observations ``(N, O)`` and infos."""
Policy = Callable[[Sequence[int]], Acting]
"""Returns what acts in episodes of these seeds, from their start."""

FILES: dict[str, Callable[[Path], Any]] = {
    ".zip": policy_from_sb3,
    ".onnx": policy_from_onnx,
    ".safetensors": lambda file: load_policy(file)[0],
}


def read_policy(policy: Any, robot: Robot) -> Policy:
    """Return what acts for a policy of any kind, which has been tried on the robot.

    Args:
        policy: a function of one observation; a module of TorchRL, or of torch, of a batch; a model
            of Stable-Baselines3; a file of one (zip), of ONNX or of this library; or None, which
            draws actions at random.
        robot: in which it acts.

    Raises:
        ConfigurationError: for anything else, or sizes that are not those of the robot.
        ArtefactError: for a file that holds no policy.
    """
    name = f"compare: policy={name_of(policy)}"
    if isinstance(policy, str | Path):
        read = FILES.get(Path(policy).suffix)
        if read is None:
            raise ConfigurationError(f"{name}: expected a file NAME{', NAME'.join(FILES)}")
        policy = read(Path(policy))
    if policy is None:
        return partial(_random, robot.first.action_space)
    act = _acting(policy, robot, name)
    wanted, sizes = robot.sizes, _sizes(policy)
    if sizes is not None and sizes != wanted:
        raise ConfigurationError(
            f"{name}: has {sizes[0]} observations and {sizes[1]} actions, but {robot.name} has "
            f"{wanted[0]} and {wanted[1]}; give a policy of this robot"
        )
    observation, _ = robot.first.reset(seed=0)
    with refusing(f"{name}: fails on an observation of {robot.name} with {wanted[0]} numbers"):
        action = np.asarray(act(observation[None], {}))
    if action.shape != (1, wanted[1]):
        raise ConfigurationError(
            f"{name}: returns an action of the shape {action.shape[1:]}, but {robot.name} has "
            f"{wanted[1]} actions; give a policy of this robot"
        )
    return lambda seeds: act


def name_of(policy: Any) -> str:
    """Return what a policy is called.

    >>> name_of("models/hopper.zip"), name_of(None)
    ('hopper.zip', 'random actions')
    """
    if policy is None:
        return "random actions"
    if isinstance(policy, str | Path):
        return Path(policy).name
    return getattr(policy, "__name__", type(policy).__name__)


def _acting(policy: Any, robot: Robot, name: str) -> Acting:
    """Return what acts for a policy without a memory."""
    if isinstance(policy, TensorDictModuleBase):
        env = robot.first.unwrapped
        return partial(_of_torchrl, policy, env if isinstance(env, EnvRobot) else None)
    if isinstance(policy, torch.nn.Module):
        return partial(_of_torch, policy)
    if hasattr(policy, "predict"):  # of Stable-Baselines3
        return lambda observations, infos: policy.predict(observations, deterministic=True)[0]
    if callable(policy):
        return lambda observations, infos: np.stack([_array(policy(row)) for row in observations])
    raise ConfigurationError(
        f"{name}: expected a function of an observation, a module of TorchRL, a model of "
        "Stable-Baselines3, a file of one (zip), of ONNX or of afm_rl (safetensors), or None"
    )


@torch.no_grad()
def _of_torch(policy: Any, observations: np.ndarray, infos: Any) -> np.ndarray:
    values = torch.as_tensor(observations, dtype=torch.float32, device=_device(policy))
    return policy(values).cpu().numpy()


@torch.no_grad()
def _of_torchrl(
    policy: TensorDictModuleBase, env: EnvRobot | None, observations: np.ndarray, infos: Any
) -> np.ndarray:
    count, values = len(observations), torch.as_tensor(observations)
    if env is None:
        data, key = {"observation": values.float()}, "action"
    else:
        sizes = [shape.numel() for shape, _ in env.parts.values()]
        parts = zip(env.parts.items(), values.split(sizes, -1), strict=True)
        data = {key: part.view(count, *shape).to(dtype) for (key, (shape, dtype)), part in parts}
        key = env.env.action_key
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return policy(TensorDict(data, [count], device=_device(policy)))[key].cpu().numpy()


def _random(space: Any, seeds: Sequence[int]) -> Acting:
    """Return random actions, the same ones in each episode of a seed."""
    draws = [np.random.default_rng(seed) for seed in seeds]

    def act(observations: np.ndarray, infos: Any) -> np.ndarray:
        return np.stack([draw.uniform(space.low, space.high) for draw in draws])

    return act


def _device(policy: torch.nn.Module) -> torch.device:
    return next(policy.parameters(), torch.zeros(0)).device


def _array(action: Any) -> np.ndarray:
    return np.asarray(action.detach().cpu() if isinstance(action, torch.Tensor) else action)


def _sizes(policy: Any) -> tuple[int, int] | None:
    """Return the sizes of observation and action that a policy has, if it says them."""
    if hasattr(policy, "observation_size"):
        return policy.observation_size, getattr(policy, "action_size", None) or len(policy.low)
    spaces = [getattr(policy, name, None) for name in ("observation_space", "action_space")]
    shapes: list[Any] = [getattr(space, "shape", None) for space in spaces]
    if any(shape is None or len(shape) != 1 for shape in shapes):
        return None
    return shapes[0][0], shapes[1][0]
