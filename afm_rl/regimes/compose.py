"""Several families of regimes one after the other, and those of any robot's actuators."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError, check_choice
from afm_rl.regimes.base import Constant, Regime
from afm_rl.regimes.commands import DeadZone, Permutation, Quantisation, Saturation
from afm_rl.regimes.gains import ActionGain, AsymmetricGain, Bias, DeadActuator, GainNoise
from afm_rl.regimes.late import Backlash, Delay, Lag


class Compose(Regime):
    """Several families in sequence: the first one acts on the action first.

    Families that are nominal for the whole batch are skipped. All noisy families have the same
    noise.

    Args:
        regimes: the families, by name; or a list, whose names are the indices. Those that depend
            on previous actions come first.
        prior: lists of family names: each draw picks one list at random and draws the families in
            it, the others stay nominal. None: all families are drawn.

    Raises:
        ConfigurationError: for families that cannot be combined, or an unknown name.

    >>> from afm_rl.regimes import ActionGain
    >>> both = Compose({"worn": ActionGain(["a_gain"]), "turned": ActionGain(["b_gain"])})
    >>> both.apply(torch.ones(1), both.encode({"a_gain": 2.0, "b_gain": -3.0}), torch.zeros(1))
    tensor([-6.])
    """

    def __init__(
        self,
        regimes: Mapping[str, Regime] | Sequence[Regime],
        prior: Sequence[Sequence[str]] | None = None,
    ) -> None:
        if not isinstance(regimes, Mapping):
            regimes = {str(index): regime for index, regime in enumerate(regimes)}
        for name, regime in regimes.items():
            if not isinstance(regime, Regime):
                raise ConfigurationError(f"regimes: {name}={regime!r}: expected a Regime")
        self.regimes = dict(regimes)
        families = list(self.regimes.values())
        self.names = tuple(name for regime in families for name in regime.names)
        self.identity = tuple(value for regime in families for value in regime.identity)
        twice = {name for name in self.names if self.names.count(name) > 1}
        if not families or twice:
            raise ConfigurationError(
                f"regimes: expected families with distinct parameter names, got {self.names}"
            )
        late = [name for name, regime in self.regimes.items() if regime.history]
        if late != list(self.regimes)[: len(late)]:
            raise ConfigurationError(
                f"regimes: {', '.join(late)} depend on previous actions: put such families first"
            )
        self.limits = {name: limit for each in families for name, limit in each.limits.items()}
        self.history = sum(regime.history for regime in families)
        self.by_state = any(regime.by_state for regime in families)
        self.noisy = any(regime.noisy for regime in families)
        ends = itertools.accumulate(len(regime.names) for regime in families)
        self._nominal = Constant(self.identity)
        self._parts = [slice(e - len(f.names), e) for f, e in zip(families, ends, strict=True)]
        self.prior = None if prior is None else [self._known(row) for row in prior]
        if self.prior == []:
            raise ConfigurationError("prior=[]: expected at least one list of families, or none")

    @property
    def closed_form(self) -> bool:
        return all(regime.closed_form for regime in self.regimes.values())

    def apply(
        self,
        action: Tensor,
        parameters: Tensor,
        state: Tensor,
        past: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> Tensor:
        action = _spread(action, parameters)
        active = self._active(parameters)
        late = sum(regime.history > 0 for regime, _ in active)
        for place, (regime, part) in enumerate(active):
            before = None if past is None else past[..., : regime.history, :]
            action = regime.apply(action, part, state, before, noise)
            if past is not None and place + 1 < late:
                past = _effects(regime, past, part, state)
        return action

    def inverse(
        self, action: Tensor, parameters: Tensor, state: Tensor, low: Tensor, high: Tensor
    ) -> Tensor:
        """Undo the last family first and clamp at the end.

        If an intermediate result exceeds the bounds, the result is clamped and need not be the
        nearest. Only rows in which a family without a closed form is active are searched.
        """
        free = torch.full_like(high, torch.inf)
        action, active = _spread(action, parameters), self._active(parameters)
        command = action
        for regime, part in reversed([pair for pair in active if pair[0].closed_form]):
            command = regime.inverse(command, part, state, -free, free)
        command = command.clamp(low, high)
        slow = [~regime.is_identity(part) for regime, part in active if not regime.closed_form]
        if slow:
            rows = torch.stack(slow).any(0).expand(action.shape[:-1])
            a, p, s = (part.expand(*rows.shape, -1)[rows] for part in (action, parameters, state))
            command = command.clone()
            command[rows] = self.search(a, p, s, low, high)
        return command

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        """Draw parameters ``(*shape, F)``: one list of the prior each, or every family."""
        if self.prior is None:
            return self.draw(list(self.regimes), shape, generator)
        table = torch.zeros(len(self.prior), len(self.names), dtype=torch.bool)
        for row, names in zip(table, self.prior, strict=True):
            for name, part in zip(self.regimes, self._parts, strict=True):
                row[part] = name in names
        chosen = torch.randint(len(self.prior), shape, generator=generator)
        drawn = self.draw(sorted({name for row in self.prior for name in row}), shape, generator)
        return torch.where(table[chosen], drawn, torch.tensor(self.identity))

    def draw(
        self,
        names: Sequence[str],
        shape: tuple[int, ...],
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Draw the named families from their priors; the others stay nominal, ``(*shape, F)``.

        Raises:
            ConfigurationError: for an unknown name.
        """
        self._known(names)
        return torch.cat(
            [
                regime.sample(shape, generator)
                if name in names
                else torch.tensor(regime.identity).expand(*shape, -1)
                for name, regime in self.regimes.items()
            ],
            -1,
        )

    def physics_of(self, parameters: Tensor) -> Tensor | None:
        """Return the columns of the first family that has any."""
        parts = zip(self.regimes.values(), self._parts, strict=True)
        columns = (regime.physics_of(parameters[..., at]) for regime, at in parts)
        return next((rows for rows in columns if rows is not None), None)

    def encode(self, values: Mapping[str, float]) -> Tensor:
        self.check_names(values)
        families = self.regimes.values()
        own = [{name: values[name] for name in f.names if name in values} for f in families]
        return torch.cat([f.encode(mine) for f, mine in zip(families, own, strict=True)])

    def _known(self, names: Sequence[str]) -> list[str]:
        if isinstance(names, str) or not isinstance(names, Sequence):
            raise ConfigurationError(f"regimes: {names!r}: expected a list of families")
        return [check_choice("regimes: family", name, self.regimes) for name in names]

    def _active(self, parameters: Tensor) -> list[tuple[Regime, Tensor]]:
        """Return the families that are not nominal everywhere, with their parameters."""
        rows = (parameters != self._nominal.like(parameters)).reshape(-1, len(self.names))
        changed = rows.sum(0).tolist()  # faster than any
        pairs = zip(self.regimes.values(), self._parts, strict=True)
        return [(regime, parameters[..., at]) for regime, at in pairs if any(changed[at])]


def _spread(action: Tensor, parameters: Tensor) -> Tensor:
    """Give the action the batch shape of the result, also if no family is active."""
    if action.shape[:-1] == parameters.shape[:-1]:
        return action
    batch = torch.broadcast_shapes(action.shape[:-1], parameters.shape[:-1])
    return action.expand(*batch, action.shape[-1])


def _effects(regime: Regime, past: Tensor, parameters: Tensor, state: Tensor) -> Tensor:
    """Return the effects of past commands ``(*B, H, A)`` under a regime with a history of D.

    Newest first, ``(*B, H - D, A)``: of the oldest D the commands before are not known.
    """
    before = past.unfold(-2, regime.history + 1, 1).mT  # (*B, H - D, D + 1, A), each newest first
    rows = parameters.unsqueeze(-2), state.unsqueeze(-2)
    return regime.apply(before[..., 0, :], *rows, before[..., 1:, :])


def actuator_regimes(low: Sequence[float], high: Sequence[float]) -> dict[str, Regime]:
    """Return families for A actuators, by name, in the order in which they act.

    Parameters of single actuators end in their index: ``gain_0``, ``bias_0``, ``from_0`` (which
    command actuator 0 receives), ``gain_0_up`` and ``gain_0_down`` (by direction), ``loss_0`` (lost
    share of its effect). Those of all are ``delay``, ``lag``, ``backlash``, ``quantum``,
    ``saturation``, ``dead_zone`` and ``gain_noise``.

    Args:
        low: lowest action, ``(A,)``.
        high: highest action, ``(A,)``.

    >>> import torch
    >>> from afm_rl.regimes import Compose
    >>> both = Compose(actuator_regimes([-1.0, -1.0], [1.0, 1.0]))
    >>> swapped = both.encode({"from_0": 1, "from_1": 0, "gain_1": -1.0})
    >>> both.apply(torch.tensor([0.5, 0.2]), swapped, torch.zeros(4))
    tensor([ 0.2000, -0.5000])
    """
    half = [(above - below) / 2 for below, above in zip(low, high, strict=True)]
    axes = range(len(half))
    families: dict[str, Regime] = {
        "delay": Delay(),
        "lag": Lag(),
        "backlash": Backlash(half),
        "permutation": Permutation([f"from_{k}" for k in axes], half),
        "quantisation": Quantisation(half),
        "saturation": Saturation(half),
        "dead_zone": DeadZone(half),
        "gain": ActionGain([f"gain_{k}" for k in axes], low=0.3, high=1.5),
        "asymmetric": AsymmetricGain([f"gain_{k}" for k in axes]),
        "dead": DeadActuator([f"loss_{k}" for k in axes]),
        "gain_noise": GainNoise(),
        "bias": Bias([f"bias_{k}" for k in axes], half, span=(-0.3, 0.3)),
    }
    return families
