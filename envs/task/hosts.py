"""Tasks whose world is somebody's environment, which keeps its state to itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from afm_rl.dynamics import UnknownDynamics
from afm_rl.envs.task.task import Reward, Task
from afm_rl.errors import ConfigurationError, check_count
from afm_rl.spaces.manifold import Manifold


class Host:
    """One environment without a batch, and what led to its state: seed and actions since."""

    def __init__(self, env: EnvBase, key: NestedKey) -> None:
        self.env, self.key = env, key
        self.seed = 0
        self.actions: list[Tensor] = []

    def reset(self, seed: int) -> Tensor:
        """Begin an episode; return its first observation ``(S,)``."""
        self.env.set_seed(seed)
        self.seed, self.actions, self.td = seed, [], self.env.reset()
        return self.td[self.key].clone()

    def step(self, action: Tensor) -> Any:
        """Execute an action ``(A,)``, clamped to the action bounds; return what follows."""
        spec = self.env.full_action_spec["action"]
        self.actions.append(action.clone())
        executed = spec.project(action.to(spec.dtype).reshape(spec.shape))
        after = self.env.step(self.td.set("action", executed))["next"]
        self.td = after.exclude("reward")
        return after


@dataclass(frozen=True, kw_only=True)
class HostedTask(Task):
    """A task in which every mission has an environment of its own; one batch at a time.

    Args:
        make: returns such an environment.
        key: of its observation.

    See :class:`~afm_rl.envs.Task` for the others. The reward that counts is the environment's.
    """

    make: Callable[[], EnvBase]
    key: NestedKey = "observation"
    hosts: dict[int, Host] = field(default_factory=dict)

    def begin(
        self, seeds: Tensor, rows: Tensor | None = None, physics: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return first observations and ``slot`` ``(*B)``, the number of the environment."""
        poses = torch.zeros(seeds.numel(), len(self.state_names))
        rows = torch.ones_like(seeds, dtype=torch.bool) if rows is None else rows
        for slot in rows.flatten().nonzero().flatten().tolist():
            if slot not in self.hosts:
                self.hosts[slot] = Host(self.make(), self.key)
            poses[slot] = self.hosts[slot].reset(int(seeds.flatten()[slot]))
        slots = torch.arange(seeds.numel()).reshape(seeds.shape)
        return {"pose": poses.reshape(*seeds.shape, -1), "slot": slots}

    def step(
        self, data: Any, action: Tensor, physics: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return next observation, reward ``(*B)`` and whether the episode ends ``(*B)``."""
        slots, plan = data["slot"].flatten().tolist(), action.flatten(0, -2)
        after = [self.hosts[slot].step(own) for slot, own in zip(slots, plan, strict=True)]
        ahead = torch.stack([td[self.key] for td in after]).reshape(data["pose"].shape)
        reward, done = (
            torch.stack([td[name].reshape(()) for td in after]).reshape(data["slot"].shape)
            for name in ("reward", "done")
        )
        self._check_finite(reward, ahead)
        return ahead, reward, done

    def history(self) -> dict[str, dict[str, Any]]:
        empty = torch.zeros(0, len(self.low))
        return {
            str(slot): {
                "seed": host.seed,
                "actions": torch.stack(host.actions) if host.actions else empty,
            }
            for slot, host in self.hosts.items()
        }

    def replay(self, history: Mapping[str, Mapping[str, Any]]) -> None:
        """Bring each environment into the state that a history led to, by living through it."""
        for slot, past in history.items():
            host = self.hosts.setdefault(int(slot), Host(self.make(), self.key))
            host.reset(past["seed"])
            for action in past["actions"]:
                host.step(action)


def environment_task(
    env: Callable[[], EnvBase],
    reward: Reward | None,
    steps: int = 1000,
    dt: float = 0.1,
    observation_key: NestedKey = "observation",
    action_low: Any = None,
    action_high: Any = None,
    name: str | None = None,
) -> HostedTask:
    """Return a task in a user's environment.

    Args:
        env: class derived from ``EnvBase``, or a function that makes an environment.
        reward: reward of observations for planning: ``reward(state, action, next_state)``, batched.
        steps: largest number of steps of an episode.
        dt: time of a step (s).
        observation_key: key of a vector that contains the state.
        action_low: lowest action; the environment's if None.
        action_high: highest action.
        name: short name; the class's if None.

    Raises:
        ConfigurationError: if observation or action is not a vector, or the reward is missing.
    """
    host = env()
    if not isinstance(host, EnvBase):
        raise ConfigurationError(
            f"robot.env={env!r}: makes {host!r:.80}, expected a TorchRL EnvBase"
        )
    specs = {
        "observation": host.observation_spec.get(observation_key, None),
        "action": host.full_action_spec.get("action", None),
    }
    for kind, spec in specs.items():
        if spec is None or spec.ndim != 1 or not spec.dtype.is_floating_point:
            whose = f"robot.id={name}" if name else f"robot.env: {type(host).__name__}"
            real = spec is None or spec.dtype.is_floating_point
            raise ConfigurationError(
                f"{whose}: its {kind} is {spec if real else 'discrete'}; expected one vector of "
                "real numbers, without a batch dimension"
            )
    if reward is None:
        raise ConfigurationError("robot.reward: expected a function for planning")
    size, box = specs["observation"].shape[-1], specs["action"].space
    own = [
        getattr(box, end, torch.full(specs["action"].shape, torch.inf)) for end in ("low", "high")
    ]
    low, high = (
        bound.tolist() if given is None else given
        for bound, given in zip(own, (action_low, action_high), strict=True)
    )
    return HostedTask(
        name=name or type(host).__name__,
        world=UnknownDynamics(Manifold(size), len(low)),
        start=lambda seed: (Host(host, observation_key).reset(seed), torch.zeros(0)),
        reward=reward,
        low=low,
        high=high,
        dt=dt,
        steps=check_count("robot.steps", steps),
        state_names=[f"s_{k}" for k in range(size)],
        action_names=[f"a_{k}" for k in range(len(low))],
        make=env,
        key=observation_key,
    )
