"""Controls that an environment makes of actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, TypeAlias

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError

Numbers: TypeAlias = float | Sequence[float] | Sequence[Sequence[float]]
ActionMap: TypeAlias = Literal["range"] | tuple[Numbers, Numbers]


def gain_and_offset(action_map: ActionMap, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return k and b of controls :math:`u = k a + b`.

    Args:
        action_map: ``"range"``, by which actions from -1 to 1 span the range of the controls; or k,
            a number, one for each action ``(A,)``, or a matrix ``(U, A)``, and b, a number or
            ``(U,)``.
        low: lowest controls, ``(U,)``; not finite where there is no limit.
        high: highest controls.

    Returns:
        k, ``(A,)`` or ``(U, A)``, and b ``(U,)``, in double precision.

    Raises:
        ConfigurationError: for anything else, and for the range of controls without limits.

    >>> low, high = torch.tensor([-0.5, 0.0]), torch.tensor([1.5, 1.0])
    >>> gain, offset = gain_and_offset("range", low, high)
    >>> gain.tolist(), offset.tolist()
    ([1.0, 0.5], [0.5, 0.5])
    """
    count = len(low)
    expected = (
        f"expected 'range', or a pair: gains, one for each of {count} actions or a matrix of "
        f"{count} rows, and offsets, one for each of {count} controls, finite all, gains not 0"
    )
    if isinstance(action_map, str):
        if action_map != "range":
            raise ConfigurationError(f"action_map={action_map!r}: {expected}")
        gain, offset = (high - low) / 2, (high + low) / 2
        if not bool(gain.isfinite().all() and (gain > 0).all()):
            raise ConfigurationError(
                "action_map='range': some controls have no limits; give gains and offsets"
            )
        return gain.double(), offset.double()
    try:
        gain, offset = (torch.as_tensor(part, dtype=torch.float64) for part in action_map)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ConfigurationError(f"action_map={str(action_map)[:80]}: {expected}") from error
    gain = gain.expand(count) if gain.dim() == 0 else gain
    sound = gain.isfinite().all() and offset.isfinite().all() and gain.any(0).all()
    if len(gain) != count or gain.dim() > 2 or offset.shape not in ((), (count,)) or not sound:
        raise ConfigurationError(f"action_map={str(action_map)[:80]}: {expected}")
    return gain.clone(), offset.expand(count).clone()


def check_range(given: tuple[Any, Any], control_range: tuple[Tensor, Tensor]) -> None:
    """Refuse an action space that differs from the range of a simulation's actions.

    Args:
        given: lowest and highest actions, ``(*B, A)``.
        control_range: those of the simulation, ``(A,)``, infinite where there is no limit.

    Raises:
        ConfigurationError: if they differ.

    >>> check_range(([-1.0], [1.0]), (torch.tensor([-1.0]), torch.tensor([torch.inf])))
    """
    ends = [torch.as_tensor(end).to(limit) for end, limit in zip(given, control_range, strict=True)]
    counts = [end.shape[-1] for end in (ends[0], control_range[0])]
    if counts[0] != counts[1]:
        said = f"{counts[0]} actions, but {counts[1]} controls of the simulation"
    else:
        pairs = zip(ends, control_range, strict=True)
        same = [end.isclose(limit, atol=1e-6) | limit.isinf() for end, limit in pairs]
        odd = (~(same[0] & same[1])).reshape(-1, counts[0]).any(0).nonzero().flatten().tolist()
        if not odd:
            return
        low, high, *limits = (
            float(x.reshape(-1, counts[0])[0, odd[0]])
            for x in (*ends, control_range[0], control_range[1])
        )
        said = (
            f"action {odd[0]} lies between {low:.4g} and {high:.4g}, its control between "
            f"{limits[0]:.4g} and {limits[1]:.4g} ({len(odd)} of {counts[0]} actions differ)"
        )
    raise ConfigurationError(
        f"{said}. If the environment scales its actions, check_model(env) names the map; give "
        "action_map='range' or action_map=(gain, offset), or action_map=(1.0, 0.0) if actions are "
        "controls. If a wrapper or transform scales them, put the correction before those that "
        "change actions"
    )
