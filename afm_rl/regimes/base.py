"""What changes under the robot: regimes as pure functions of the action."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError, check_number

MOST = 10.0  # half ranges: more are typing errors


class Constant:
    """A row of numbers as a tensor of any type and on any device, made once for each.

    >>> Constant([1, 2]).like(torch.zeros(2, dtype=torch.float64))
    tensor([1., 2.], dtype=torch.float64)
    """

    def __init__(self, values: Iterable[float]) -> None:
        self.values = tuple(float(value) for value in values)
        self._tensors: dict[tuple[torch.dtype, torch.device], Tensor] = {}

    def like(self, other: Tensor) -> Tensor:
        """Return the numbers ``(N,)`` with type and device of ``other``."""
        key = other.dtype, other.device
        if key not in self._tensors:
            self._tensors[key] = other.new_tensor(self.values)
        return self._tensors[key]


class HalfRange(Constant):
    """Half ranges of the A action axes, finite and above zero: the unit of many parameters.

    >>> HalfRange([1.0, 1.5]).values
    (1.0, 1.5)
    """

    def __init__(self, values: Sequence[float]) -> None:
        name = "half_range, half of action_high - action_low"
        super().__init__([check_number(name, x, low=0.0, open_low=True) for x in values])

    def like(self, other: Tensor) -> Tensor:
        """Return the half ranges ``(A,)`` with type and device of actions ``(*B, A)``.

        Raises:
            ConfigurationError: if there is not one for each action.
        """
        if other.shape[-1] != len(self.values):
            raise ConfigurationError(
                f"half_range={list(self.values)}: the robot has {other.shape[-1]} actions; give "
                "one number for each"
            )
        return super().like(other)


def check_span(
    name: str, span: Sequence[float], low: float = -math.inf, high: float = math.inf
) -> tuple[float, float]:
    """Return the two ends of a range to draw from: finite numbers in [low, high], in order.

    >>> check_span("span", [0.2, 0.6], low=0.0)
    (0.2, 0.6)
    """
    if isinstance(span, str) or not isinstance(span, Sequence) or len(span) != 2:
        raise ConfigurationError(f"{name}={span!r}: expected two numbers, lowest and highest")
    first, last = (check_number(name, value, low=low, high=high) for value in span)
    if first > last:
        raise ConfigurationError(f"{name}={span!r}: expected the lower number first")
    return first, last


def draw_between(
    span: tuple[float, float], size: tuple[int, ...], generator: torch.Generator | None
) -> Tensor:
    """Draw numbers of shape ``size``, uniform in the range.

    >>> draw_between((2.0, 2.0), (3,), None)
    tensor([2., 2., 2.])
    """
    low, high = span
    return low + (high - low) * torch.rand(size, generator=generator)


class Regime:
    """A family of regimes: the effective action as a function of action and parameters.

    Simulator and oracle use the same object. Its parameters are one row of named
    numbers, so the regimes of a batch of missions are one tensor ``(*B, F)``. A
    family with invalid settings raises a
    :class:`~afm_rl.errors.ConfigurationError`.

    Attributes:
        names: names of the F parameters, in order.
        identity: their nominal values, which do not change an action, bit for bit.
        limits: lowest and highest value of parameters with limits.
        history: number of previous actions on which the effect depends, D.
        noisy: whether the effect is random.
        by_state: whether it depends on the state.
        span: lowest and highest value of a prior that is uniform and the same for all
            parameters.
    """

    names: tuple[str, ...]
    identity: tuple[float, ...]
    limits: Mapping[str, tuple[float, float]] = MappingProxyType({})
    history: int = 0
    noisy: bool = False
    by_state: bool = False
    span: tuple[float, float]

    effect_of: Callable[..., Tensor]
    """``effect_of(action, parameters) -> Tensor``, in the place of :meth:`apply`. A family that
    depends on the state, on previous actions, or on chance is given ``state``, ``past`` of D
    actions, ``noise``, too, in this order; without the latter two an action stays what it is."""
    command_for: Callable[..., Tensor]
    """``command_for(effect, parameters) -> Tensor``, an action with an effect, in the box or not;
    of a family that depends on the state also ``state``. In the place of :meth:`inverse`."""

    def apply(
        self,
        action: Tensor,
        parameters: Tensor,
        state: Tensor,
        past: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> Tensor:
        """Return the effect of an action, ``(*B, A)``.

        Args:
            action: commanded action, ``(*B, A)``.
            parameters: parameters of the regime, ``(*B, F)``.
            state: state in which the action acts, ``(*B, S)``.
            past: the previous D commanded actions, newest first, ``(*B, D, A)``; None if they
                are unknown, then there is no delay.
            noise: standard normal numbers, ``(*B, A)``; None for the mean effect.
        """
        if (self.history and past is None) or (self.noisy and noise is None):
            return action
        before = past[..., : self.history, :] if self.history and past is not None else None
        given = [state if self.by_state else None, before, noise if self.noisy else None]
        return self.effect_of(action, parameters, *(x for x in given if x is not None))

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        """Draw parameters ``(*shape, F)`` from the family's prior: uniform in ``span``.

        Raises:
            ConfigurationError: for a family that has neither a ``span`` nor a ``sample``.
        """
        if not hasattr(self, "span"):
            raise ConfigurationError(
                f"{type(self).__name__}: has no prior to draw from; give it span = (low, high), or "
                "a method sample(shape, generator)"
            )
        return draw_between(self.span, (*shape, len(self.names)), generator)

    def inverse(
        self, action: Tensor, parameters: Tensor, state: Tensor, low: Tensor, high: Tensor
    ) -> Tensor:
        r"""Return the action within bounds whose effect is nearest to ``action``, ``(*B, A)``.

        :math:`\operatorname{argmin}_{u \in [l, h]} \|(\mathrm{apply}(u) - a) / (h - l)\|`, by a
        search that narrows around the best of a grid of points, or by :attr:`command_for`.
        """
        if not self._has_formula:
            return self.search(action, parameters, state, low, high)
        given = (state,) if self.by_state else ()
        return self.command_for(action, parameters, *given).clamp(low, high)

    def search(
        self, action: Tensor, parameters: Tensor, state: Tensor, low: Tensor, high: Tensor
    ) -> Tensor:
        """Return the inverse by a search over effects, to 0.2 % of the bounds."""
        grid = torch.quasirandom.SobolEngine(len(low)).draw(64).to(low)
        centre, span = ((low + high) / 2).expand_as(action), high - low
        wide = [part.unsqueeze(-2) for part in (parameters, state)]
        for shrink in range(8):
            reach = span * 0.45**shrink
            points = centre.unsqueeze(-2) + (grid - 0.5) * reach
            points = torch.cat([centre.unsqueeze(-2), points], -2)
            points = torch.minimum(torch.maximum(points, low), high)
            miss = (self.apply(points, *wide) - action.unsqueeze(-2)) / span
            best = miss.square().sum(-1).argmin(-1)[..., None, None]
            centre = points.gather(-2, best.expand(*best.shape[:-1], len(low))).squeeze(-2)
        return centre

    @property
    def closed_form(self) -> bool:
        """Whether :meth:`inverse` is a formula, which also works without bounds."""
        return self._has_formula or type(self).inverse is not Regime.inverse

    @property
    def _has_formula(self) -> bool:
        """Whether there is a :attr:`command_for`, and no subclass of it overrides the effect."""
        bases = type(self).__mro__
        owner = next((base for base in bases if "command_for" in vars(base)), None)
        inverted, used = (getattr(kind, "effect_of", None) for kind in (owner, type(self)))
        return owner is not None and inverted is used

    def encode(self, values: Mapping[str, float]) -> Tensor:
        """Return the parameter row ``(F,)`` with ``values``; other parameters are nominal.

        Raises:
            ConfigurationError: for an unknown name, or a value that is not finite or beyond
                its limits.
        """
        self.check_names(values)
        row = list(self.identity)
        for name, value in values.items():
            low, high = self.limits.get(name, (-math.inf, math.inf))
            number = check_number(f"regimes: {name}", value, low=low, high=high)
            row[self.names.index(name)] = number
        return torch.tensor(row)

    @staticmethod
    def distinct(names: Sequence[str], axes: int | None = None) -> tuple[str, ...]:
        """Return ``names`` as a tuple; they must be distinct, one for each of the ``axes``."""
        axis_names = tuple(names)
        if not len({*axis_names}) == len(axis_names) == (axes or len(axis_names) or 1):
            count = "" if axes is None else f"{axes} "
            raise ConfigurationError(
                f"names={axis_names}: expected {count}distinct names, one per axis"
            )
        return axis_names

    def check_names(self, names: Iterable[str]) -> None:
        """Check that all ``names`` are parameters; the error names the first that is not."""
        for name in names:
            if name not in self.names:
                raise ConfigurationError(
                    f"regimes: unknown parameter {name!r}; allowed: {', '.join(self.names)}"
                )

    def check_limits(self, parameters: Tensor) -> None:
        """Check that parameters ``(*B, F)`` are within their limits; the error names the first."""
        for name, (low, high) in self.limits.items():
            values = parameters[..., self.names.index(name)]
            wrong = values[~((values >= low) & (values <= high))]
            if wrong.numel():
                raise ConfigurationError(
                    f"missions: parameters: {name}={wrong[0].item():g}: expected a number in "
                    f"[{low:g}, {high:g}]"
                )

    def describe(self, row: Tensor) -> str:
        """Return the values of a parameter row ``(F,)`` that are not nominal, in words."""
        nominal = torch.tensor(self.identity, dtype=row.dtype).tolist()
        pairs = zip(self.names, row.tolist(), nominal, strict=True)
        return ", ".join(f"{name} = {x:g}" for name, x, usual in pairs if x != usual) or "nominal"

    def physics_of(self, parameters: Tensor) -> Tensor | None:
        """Return the columns of :class:`~afm_rl.regimes.Physics`, ``(*B, P)``; None without."""
        return None

    def is_identity(self, parameters: Tensor) -> Tensor:
        """Return whether this is the nominal regime, ``(*B)`` booleans."""
        nominal = torch.tensor(self.identity, device=parameters.device, dtype=parameters.dtype)
        return (parameters == nominal).all(-1)


class HalfRangeRegime(Regime):
    """A regime of commands in half ranges, with one parameter, the same on all axes.

    Args:
        half_range: half ranges of the action axes, the unit of commands and parameter.
        span: lowest and highest value of the parameter in the prior, uniform.
    """

    def __init__(self, half_range: Sequence[float], span: Sequence[float] | None = None) -> None:
        self.half_range = HalfRange(half_range)
        limits = self.limits[self.names[0]]
        self.span = check_span("span", self.span if span is None else span, *limits)


def same_command(self: Regime, effect: Tensor, parameters: Tensor) -> Tensor:
    """Return the effect: on average, or in the long run, an action has the effect of itself."""
    return effect
