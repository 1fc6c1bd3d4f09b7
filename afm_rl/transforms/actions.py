"""Planned actions as they may come, made finite and brought within the action bounds."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.data import TensorSpec

from afm_rl.compiling.tracing import same
from afm_rl.correction.base import Fields
from afm_rl.errors import ConfigurationError
from afm_rl.faults import finite, safe_action
from afm_rl.transforms.loop_options import LoopOptions


def precise(dtype: torch.dtype) -> torch.dtype:
    """Return the type in which numbers are remembered: theirs, or single precision for 16 bits."""
    return dtype if dtype in (torch.float32, torch.float64) else torch.float32


def check_precision() -> None:
    """Refuse a default type of 16 bits, in which the belief would be computed."""
    if torch.get_default_dtype().itemsize < 4:
        raise ConfigurationError(
            f"torch.get_default_dtype() is {torch.get_default_dtype()}: expected float32 or "
            "float64 while actions are corrected; set_default_dtype(torch.float32), and give "
            "16 bits to the policy alone"
        )


def bounds_of(action_spec: TensorSpec | None) -> tuple[Tensor, Tensor]:
    """Return the lowest and the highest action of a spec.

    Raises:
        ConfigurationError: if its actions are no real numbers between bounds.
    """
    space: Any = getattr(action_spec, "space", None)
    if not hasattr(space, "low") or not action_spec.dtype.is_floating_point:  # type: ignore[union-attr]
        raise ConfigurationError(
            f"action_spec={action_spec}: expected a Bounded spec of real numbers; limit the "
            "environment's actions first"
        )
    return space.low, space.high


def stacked(bounds: tuple[Tensor, Tensor], like: Tensor) -> Tensor:
    """Return the lowest and the highest action ``(*B, 2, A)`` for actions ``(*B, A)``."""
    both = torch.stack(bounds, -2).to(like)
    return both.expand(*like.shape[:-1], *both.shape[-2:])


def sanitised(
    planned: Tensor, low: Tensor, high: Tensor, memory: Fields
) -> tuple[Tensor, Tensor, Tensor]:
    """Return a planned action as given, what is taken for it, and what of that is within bounds.

    Args:
        planned: ``(*B, A)``, of any real numbers.
        low: lowest action.
        high: highest action.
        memory: has the precision, and the plan before, which is taken where this is not finite.
    """
    dtype = memory["state"].dtype
    inside = planned.clamp(low, high)
    planned = planned.to(inside.dtype)  # the more precise one of plan and bounds
    if same(inside, planned):  # as most are: nothing to be done
        inside = inside.to(dtype)
        return inside, inside, inside
    planned = computable(planned, low, high, dtype)
    plan = torch.where(finite(planned).unsqueeze(-1), planned, memory["planned_action"])
    inside, _ = safe_action(plan, low, high, memory["executed_action"])
    return planned, plan, inside.to(dtype)


def computable(plan: Tensor, low: Tensor, high: Tensor, dtype: torch.dtype) -> Tensor:
    r"""Return a plan ``(*B, A)`` in a precision, with NaN where it is infinite.

    Beyond the bounds by more than :math:`\varepsilon^{-1/2}` times their distance, rounding would
    leave nothing between the bounds: there it is brought back to this distance.

    >>> computable(torch.tensor([1e30, 0.5]), -torch.ones(2), torch.ones(2), torch.float32)
    tensor([5.7936e+03, 5.0000e-01])
    """
    reach = torch.finfo(dtype).eps ** -0.5 * (high - low)
    near = plan.clamp(low - reach, high + reach)
    return torch.where(plan.abs() < torch.inf, near, torch.nan).to(dtype)


def limits_of(options: LoopOptions, bounds: Tensor, inside: Tensor, memory: Fields) -> Tensor:
    """Return between which actions ``(*B, 2, A)`` the executed one must be.

    Args:
        options: how far a correction may go, and how fast it may change.
        bounds: the action bounds, ``(*B, 2, A)``.
        inside: the planned action, within the bounds, ``(*B, A)``.
        memory: with the last planned and executed action.
    """
    size, rate = options["max_correction"], options["max_correction_rate"]
    if size is None and rate is None:
        return bounds
    (low, high), limits, centre = bounds.split(1, -2), bounds, inside.unsqueeze(-2)
    half = 0.5 * (high - low)
    if rate is not None:
        names = ("executed_action", "planned_action")
        sent, plan = (memory[name].unsqueeze(-2).clamp(low, high) for name in names)
        reach, last = half * torch.as_tensor(rate).to(half), centre + sent - plan
        limits = limits.clamp(last - reach, last + reach).clamp(low, high)
    if size is not None:  # this holds in any case
        reach = half * torch.as_tensor(size).to(half)
        limits = limits.clamp(centre - reach, centre + reach).clamp(low, high)
    return limits
