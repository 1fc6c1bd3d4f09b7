"""Planners whose plan travels with the tensordict, and those of them that try many candidates."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, TypedDict, Unpack

import torch
from annotated_types import Le
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, TensorDictPrimer
from torchrl.modules.planners.common import MPCPlannerBase

from afm_rl.compiling.devices import moved
from afm_rl.compiling.tracing import all_hold, may_look
from afm_rl.errors import ConfigurationError, check_instance, warn
from afm_rl.options import Count, Default, Natural, filled, options
from afm_rl.spaces.keys import as_key
from afm_rl.streams import Streams

Horizon = Annotated[Count, Le(10_000), "steps of a plan, H"]
Candidates = Annotated[Count, Le(1_000_000), "candidates per iteration, N"]
Iterations = Annotated[Count, Le(10_000), "refinements per step"]
ActionKey = Annotated[NestedKey, "key of the action"]


class SamplingOptions(TypedDict, total=False):
    """Options of all planners that sample, which they pass to :class:`SamplingPlanner` by name."""

    seed_key: Annotated[
        NestedKey | None, "key of the seeds; missions with one seed have the same noise"
    ]
    bounds_key: Annotated[NestedKey | None, "key of the bounds for plans; None: the action bounds"]
    action_key: Annotated[ActionKey, Default("action")]
    seed: Annotated[Natural, Default(0), "seed of the noise without a seed_key"]
    hold: Annotated[
        Count, Default(1), "steps that each action is held; plans are longer by this factor"
    ]


def moments(plans: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation ``(*B, H, A)`` of plans ``(*B, K, H, A)``.

    Weights ``(*B, K)`` are not negative; where all are zero, so are both.

    >>> plans = torch.tensor([1.0, 3.0, 9.0]).view(3, 1, 1)
    >>> [float(x) for x in moments(plans, torch.tensor([2.0, 2.0, 0.0]))]
    [2.0, 1.0]
    """
    share = weights / weights.sum(-1, keepdim=True).clamp_min(torch.finfo(weights.dtype).tiny)
    share = share[..., None, None]
    mean = (share * plans).sum(-3)
    return mean, (share * (plans - mean.unsqueeze(-3)).square()).sum(-3).sqrt()


class ZeroPrimer(TensorDictPrimer):
    """A primer of zeros that fills the batch of the reset, not that of the environment."""

    def __init__(self, spec: Composite) -> None:
        super().__init__(spec, default_value=0.0, expand_specs=True)
        self.bare = spec.clone()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Put the entries into a tensordict of any batch shape, where there is no environment."""
        return self._reset_func(tensordict, tensordict)

    def _reset_func(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        batch = tensordict_reset.batch_size  # the environment merges partial resets itself
        for key, leaf in self.bare.items(True, True):
            tensordict_reset.set(key, leaf.zero(batch).to(tensordict_reset.device))
        return tensordict_reset


def action_spec_of(env: EnvBase) -> TensorSpec:
    """Return the spec of an environment's one action, whatever its key."""
    if len(check_instance("planner.env", env, EnvBase).action_keys) != 1:
        raise ConfigurationError(
            f"planner: {type(env).__name__} takes the actions {env.action_keys}; expected one"
        )
    return env.full_action_spec[env.action_key]


def done_keys_of(env: EnvBase) -> list[NestedKey]:
    """Return the entries that end an episode; that of a group stands for those inside the group.

    >>> from types import SimpleNamespace
    >>> done_keys_of(SimpleNamespace(done_keys=["done", "terminated", ("arm", "done")]))
    ['done']
    >>> done_keys_of(SimpleNamespace(done_keys=[("arm", "done"), ("leg", "done")]))
    [('arm', 'done'), ('leg', 'done')]
    """
    paths = [(key,) if isinstance(key, str) else tuple(key) for key in env.done_keys]
    groups = [path[:-1] for path in paths if path[-1] == "done"]
    outer = [g for g in groups if not any(g != o and g[: len(o)] == o for o in groups)]
    return [unravel_key((*group, "done")) for group in outer]


def rewards_until_done(
    outcome: TensorDictBase, reward_key: NestedKey, done_keys: Sequence[NestedKey]
) -> Tensor:
    """Return rewards ``(*B, T, 1)``, zero after the step that ends an episode.

    >>> from tensordict import TensorDict
    >>> reward, done = torch.ones(3, 1), torch.tensor([[False], [True], [True]])
    >>> rewards_until_done(TensorDict(reward=reward, done=done, batch_size=3), "reward", ["done"])
    tensor([[1.],
            [1.],
            [0.]])
    """
    reward = outcome.get(reward_key)
    done = torch.stack([outcome.get(key).expand_as(reward) for key in done_keys]).any(0).int()
    ended_before = done.cumsum(outcome.batch_dims - 1) > done
    return reward.masked_fill(ended_before, 0.0)


class RecedingHorizonPlanner(MPCPlannerBase):
    """A planner that starts from its previous plan, which it keeps in the tensordict.

    So every mission of a batch has its own, resets start afresh, and branches are exact: append
    :meth:`make_tensordict_primer` to the environment. Without it each plan starts cold, and a
    warning is given once. ``memory`` are the entries that are kept, with their shapes.

    A subclass, of this class or of a planner of this library, overrides :meth:`plan`.

    Raises:
        ConfigurationError: for a subclass that overrides ``planning`` as planners of TorchRL do:
            it would not be called, as it returns no memory.
    """

    def __new__(cls, *args: Any, **settings: Any) -> RecedingHorizonPlanner:
        """Refuse methods that nobody would call, before anything else is looked at."""
        for name in ("planning", "_plan"):
            if getattr(cls, name, None) is not getattr(RecedingHorizonPlanner, name, None):
                raise ConfigurationError(
                    f"planner: {cls.__name__} overrides {name}, which is not called here; override "
                    "plan(td), which returns the action and the new memory"
                )
        return super().__new__(cls, *args, **settings)

    def __init__(
        self,
        env: EnvBase,
        memory: Mapping[NestedKey, Sequence[int]],
        action_key: NestedKey = "action",
    ) -> None:
        spec = action_spec_of(env)
        super().__init__(env, action_key=as_key(action_key))
        self.action_spec = spec
        self.action_key = as_key(action_key)
        self.memory = {as_key(key): tuple(shape) for key, shape in memory.items()}
        self.next_memory = [unravel_key(("next", key)) for key in self.memory]
        self.out_keys = [self.action_key, *self.next_memory]
        self.discarded = 0
        self._told = False

    def _apply(
        self, fn: Callable[[Tensor], Tensor], recurse: bool = True
    ) -> RecedingHorizonPlanner:
        """Move the spec too."""
        self.action_spec = moved(self.action_spec, fn)
        return super()._apply(fn, recurse)

    @abstractmethod
    def plan(self, td: TensorDictBase) -> tuple[Tensor, Sequence[Tensor]]:
        """Return the action ``(*B, A)`` and the new memory, each entry ``(*B, *shape)``.

        The action is brought into its bounds afterwards.
        """

    def make_tensordict_primer(self) -> ZeroPrimer:
        """Return the transform that puts an empty memory into every reset."""
        dtype = self.action_spec.dtype
        pairs = self.memory.items()
        return ZeroPrimer(Composite({key: Unbounded(shape, dtype=dtype) for key, shape in pairs}))

    def forward(
        self,
        tensordict: TensorDictBase,
        tensordict_out: TensorDictBase | None = None,
        **kwargs,
    ) -> TensorDictBase:
        """Write the action and the next memory."""
        action, memory = self.plan(tensordict)
        out = tensordict if tensordict_out is None else tensordict_out
        for key, value in zip(self.next_memory, memory, strict=True):
            out.set(key, value)
        return out.set(self.action_key, self._allowed(action, tensordict))

    def _allowed(self, action: Tensor, td: TensorDictBase) -> Tensor:
        """Return the nearest action that may be planned."""
        if not isinstance(self.action_spec, Bounded):
            return self.action_spec.project(action)
        return action.clamp(self.action_spec.space.low, self.action_spec.space.high)

    def planning(self, td: TensorDictBase) -> Tensor:
        """Return the action ``(*B, A)`` without writing anything."""
        return self._allowed(self.plan(td)[0], td)

    def _discard(self, finite: Tensor, found: str = "return") -> None:
        """Count what is not finite ``(*B, N)``; warn where nothing is."""
        if all_hold(finite) or not may_look(finite):
            return  # an exported planner does not count, nor does one on a GPU
        self.discarded += int((~finite).sum())
        lost = ~finite.any(-1)
        if bool(lost.any()):
            warn(
                f"planner: no finite {found} for {int(lost.sum())} of {lost.numel()} plans; "
                "the previous plan is kept"
            )

    def _recall(self, td: TensorDictBase) -> list[Tensor]:
        """Return the memory, zeros where there is none."""
        found = [td.get(key, None) for key in self.memory]
        if all(entry is not None for entry in found):
            return found
        if not self._told:
            warn(
                f"planner: no {' or '.join(map(repr, self.memory))} in the tensordict, so every "
                "plan starts cold; append planner.make_tensordict_primer() to the environment"
            )
            self._told = True
        like = {"device": self.action_spec.device, "dtype": self.action_spec.dtype}
        return [torch.zeros((*td.batch_size, *shape), **like) for shape in self.memory.values()]


class SamplingPlanner(RecedingHorizonPlanner):
    """A planner that draws candidates and rolls them out in the planning environment.

    Args:
        env: batch-unlocked environment to plan in; a :class:`PlanningEnv` is fastest.
        memory: entries that are kept from plan to plan, with their shapes.

    With a ``seed_key`` missions of one seed share their noise in any batch; without
    one, noise is drawn for the batch. The entry ``bounds_key`` ``(*B, 2, A)`` holds the lowest and
    highest action to plan with, such as the ``effect_bounds`` of
    :class:`~afm_rl.transforms.ActionFlowTransform`; where there is none the action's own bounds
    are taken, with a warning.

    Returns that are not finite are ignored and counted in :attr:`discarded`; where none is finite,
    the plan from before, shifted, stands and a warning is given.
    """

    scale: Tensor  # standard deviation of the first noise, per action

    @options("planner")
    def __init__(
        self,
        env: EnvBase,
        memory: Mapping[NestedKey, Sequence[int]],
        horizon: Horizon = 5,
        candidates: Candidates = 300,
        iterations: Iterations = 1,
        **settings: Unpack[SamplingOptions],
    ) -> None:
        chosen: SamplingOptions = filled(SamplingOptions, "planner", settings)
        super().__init__(env, memory, chosen["action_key"])
        self.hold, self.horizon = chosen["hold"], horizon
        self.candidates, self.iterations = candidates, iterations
        self.fast = hasattr(env, "returns")  # else it is stepped
        keys = chosen["seed_key"], chosen["bounds_key"]
        self.seed_key, self.bounds_key = (None if key is None else as_key(key) for key in keys)
        given = [key for key in (self.seed_key, self.bounds_key) if key is not None]
        self.in_keys = [*env.observation_spec.keys(True, True), *self.memory, *given]
        self.streams = Streams(salt=1, seed=chosen["seed"])

    def _noise(
        self, td: TensorDictBase, like: Tensor, count: int, bound: float | None = None
    ) -> Tensor:
        """Draw standard normal numbers ``(*B, count, H, A)`` for plans like ``(*B, H, A)``."""
        return self.streams.normal(
            (count, *like.shape[-2:]),
            batch=like.shape[:-2],
            seeds=None if self.seed_key is None else td.get(self.seed_key),
            bound=bound,
            device=like.device,
            dtype=like.dtype,
        )

    def _bounds(self, td: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        """Return lowest and highest action and the noise's size, ``(*B, 1, A)`` or ``(A,)``."""
        space = self.action_spec.space
        bounds = None if self.bounds_key is None else td.get(self.bounds_key, None)
        if bounds is None:
            if self.bounds_key is not None:
                warn(
                    f"planner.bounds_key={self.bounds_key!r}: the tensordict has no such entry, so "
                    "plans use the action bounds"
                )
            return space.low, space.high, self.scale
        low, high = bounds.unsqueeze(-3).unbind(-2)
        return low, high, self.scale * (high - low) / (space.high - space.low)

    def _allowed(self, action: Tensor, td: TensorDictBase) -> Tensor:
        low, high, _ = self._bounds(td)
        wide = action.unsqueeze(-2)
        return torch.minimum(torch.maximum(wide, low), high).squeeze(-2)

    def _returns(self, td: TensorDictBase, plans: Tensor) -> Tensor:
        """Return the return ``(*B, N)`` of each plan ``(*B, N, H, A)``, whose actions are held.

        One that is not finite is counted, and becomes minus infinity.
        """
        returns = self._rolled_out(td, plans)
        finite = returns.isfinite()
        self._discard(finite)
        return torch.where(finite, returns, -torch.inf)

    def _best(self, td: TensorDictBase, plans: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Return the best plans ``(*B, count, H, A)`` and their returns, see :meth:`_returns`."""
        top = self._returns(td, plans).topk(count, -1)
        index = top.indices[..., None, None].expand(*top.indices.shape, *plans.shape[-2:])
        return plans.gather(-3, index), top.values

    def _rolled_out(self, td: TensorDictBase, plans: Tensor) -> Tensor:
        if self.hold > 1:
            plans = plans.repeat_interleave(self.hold, -2)
        if self.fast:
            state, *task = self.env.entries(td)
            returns = self.env.returns(state, plans, *task)
            return returns.to(plans)  # states may be in double precision, plans in single
        batch = plans.shape[:-2]
        start = td.select(*self.env.observation_spec.keys(True, True), strict=False)
        start = start.unsqueeze(-1).expand(batch).clone()
        steps, action_key = iter(plans.unbind(-2)), self.env.action_key
        rollout = self.env.rollout(
            plans.shape[-2],
            policy=lambda now: now.set(action_key, next(steps)),
            auto_reset=False,
            tensordict=start,
            break_when_any_done=False,
            trust_policy=True,  # it takes the tensordict itself
        )
        rewards = rewards_until_done(rollout["next"], self.env.reward_key, done_keys_of(self.env))
        return rewards.sum((-2, -1)).to(plans)
