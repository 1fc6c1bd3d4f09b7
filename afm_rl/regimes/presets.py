"""Faults by name, and actuators that have them and remember what they were commanded."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from afm_rl.regimes.compose import Compose, actuator_regimes

Fault = Mapping[str, float]


def presets(actuators: int) -> dict[str, Fault]:
    """Return faults of so many actuators by name, as :meth:`Actuators.fail` takes them.

    >>> presets(2)["swapped pair"]
    {'from_0': 1, 'from_1': 0}
    """
    every, other = range(actuators), actuators // 2
    faults: dict[str, Fault] = {
        "none": {},
        "one reversed": {"gain_0": -1.0},
        "all reversed": {f"gain_{k}": -1.0 for k in every},
        "swapped pair": {"from_0": other, f"from_{other}": 0},
        "half": {f"gain_{k}": 0.5 for k in every},
        "dead": {"loss_0": 1.0},
        "bias .3": {f"bias_{k}": 0.3 for k in every},
        **{f"late {steps}": {"delay": steps} for steps in (1, 2, 4, 8)},
        **{f"lag {steps}": {"lag": float(steps)} for steps in (1, 2, 3)},
        **{f"rate .{tenths}": {"rate": tenths / 10} for tenths in (3, 2)},
        "reversed and late 2": {**{f"gain_{k}": -1.0 for k in every}, "delay": 2},
    }
    if actuators == 1:
        del faults["swapped pair"]
    return faults


def servo_faults(joints: int, one: int = 0, other: int = 1) -> dict[str, Fault]:
    """Return faults of so many position servos by name, about their pose, offsets in rad.

    Args:
        joints: how many.
        one: index of the one that fails alone.
        other: of the one that it is swapped with.

    >>> servo_faults(12, one=3)["offset .25 on one"]
    {'bias_3': 0.25}
    """
    every = range(joints)
    return {
        "none": {},
        "one reversed": {f"gain_{one}": -1.0},
        "offset .25 on one": {f"bias_{one}": 0.25},
        "offset .1 on all": {f"bias_{k}": 0.1 for k in every},
        "all at .7": {f"gain_{k}": 0.7 for k in every},
        "all at half": {f"gain_{k}": 0.5 for k in every},
        "swapped pair": {f"from_{one}": other, f"from_{other}": one},
        "late 1": {"delay": 1},
        "late 2": {"delay": 2},
    }


def shifted(past: Tensor, command: Tensor) -> Tensor:
    """Return the newest D commands ``(*B, D, A)``, newest first, after one more ``(*B, A)``.

    >>> shifted(torch.tensor([[1.0], [2.0]]), torch.tensor([3.0])).flatten()
    tensor([3., 1.])
    """
    return torch.cat([command.unsqueeze(-2), past[..., :-1, :]], -2)


class Actuators:
    r"""Actuators under a fault, with a state: the commands before, and the last effect.

    .. math:: y_t = \mathrm{clip}(g(u_t;\, u_{t-1}, \dots),\ y_{t-1} - r h,\ y_{t-1} + r h)

    with the regime g of :func:`~afm_rl.regimes.actuator_regimes` (delay, lag, permutation, gain,
    loss, bias) and a limited rate r, in half ranges h a step. The limit is not a regime, since it
    begins at the last effect, not at a command; nor is a random delay: with ``random_delay`` D
    every command takes a number of steps of its own, drawn from 0, ..., D as it is sent, and the
    newest that has arrived acts, so that none acts after a newer one. ``noise`` is the standard
    deviation (half ranges) of what is added to each effect.

    Args:
        low: lowest command, ``(A,)``.
        high: highest command, ``(A,)``.
        batch: how many are side by side, B.
        home: pose of position servos, ``(A,)``, about which they have their faults; these are then
            in the unit of the commands, not in half ranges: an offset of .1 is one of .1 rad.

    >>> motor = Actuators([-1.0], [1.0])
    >>> before = motor(torch.tensor([0.5]))
    >>> motor.fail({"gain_0": -1.0})
    >>> before, motor(torch.tensor([0.5]))
    (tensor([0.5000], dtype=torch.float64), tensor([-0.5000], dtype=torch.float64))
    """

    def __init__(
        self,
        low: Sequence[float],
        high: Sequence[float],
        batch: Sequence[int] = (),
        home: Tensor | None = None,
    ) -> None:
        families = actuator_regimes(low, high)
        self.home = torch.zeros(len(low)).double()
        if home is not None:
            low, high = [-1.0] * len(low), [1.0] * len(low)
            families, self.home = actuator_regimes(low, high), home.double()
        chosen = ("delay", "lag", "permutation", "gain", "dead", "bias")
        self.regime = Compose({name: families[name] for name in chosen})
        self.low, self.high = (torch.tensor(list(end)).double() for end in (low, high))
        self.half, self.batch = (self.high - self.low) / 2, tuple(batch)
        self.past = self.low.new_zeros(*self.batch, self.regime.history, len(self.low))
        self.steps = self.past.new_zeros(*self.batch, 1 + self.regime.history)  # of each, likewise
        self.last = self.past[..., 0, :].clone()  # effect; NaN: none yet
        self.draws = torch.Generator().manual_seed(0)
        self.reset()
        self.fail({})

    def reset(self, rows: Tensor | None = None) -> None:
        """Begin with actuators that were not used yet, those in ``rows`` ``(*B)`` or all."""
        fresh = torch.ones(self.batch, dtype=torch.bool) if rows is None else rows
        self.past[fresh], self.steps[fresh], self.last[fresh] = 0.0, 0.0, torch.nan
        if fresh.all():
            self.draws.manual_seed(0)

    def fail(self, *faults: Fault) -> None:
        """Have a fault from now on, one for all or one each; none is ``{}``.

        Raises:
            ConfigurationError: for an unknown name, or a value that it cannot have.
        """
        own = {"rate": math.inf, "random_delay": 0.0, "noise": 0.0}
        rows = [self.regime.encode({k: v for k, v in x.items() if k not in own}) for x in faults]
        others = [[fault.get(name, usual) for name, usual in own.items()] for fault in faults]
        both = torch.stack(rows).double(), torch.tensor(others).double()
        self.rows, other = (x.expand(*self.batch, -1) if self.batch else x[0] for x in both)
        self.most, self.noise = other[..., :1] * self.half, other[..., 2:] * self.half
        self.random_delay = other[..., 1:2]

    def value(self, name: str) -> Tensor:
        """Return a parameter of the fault, such as ``delay``, ``(*B)``."""
        return self.rows[..., self.regime.names.index(name)]

    @property
    def memoryless(self) -> Tensor:
        """The parameters ``(*B, F)`` without delay and lag: what a command does in the end."""
        rows = self.rows.clone()
        rows[..., [self.regime.names.index(name) for name in ("delay", "lag")]] = 0.0
        return rows

    def __call__(self, command: Tensor) -> Tensor:
        """Return the effect ``(*B, A)`` of a command, in double precision."""
        command = command.double() - self.home
        rows = self.rows.clone()
        rows[..., [self.regime.names.index("delay")]] += self._arrived()
        effect = self.regime.apply(command, rows, command[..., :1], self.past)
        lowest, highest = self.last - self.most, self.last + self.most
        effect = effect.clamp(lowest.nan_to_num(-torch.inf), highest.nan_to_num(torch.inf))
        self.past, self.last = shifted(self.past, command), effect
        if self.noise.any():
            effect = effect + self.noise * torch.randn(effect.shape, generator=self.draws).double()
        return effect + self.home

    def _arrived(self) -> Tensor:
        """Return how many steps ago the newest command that has arrived was sent, ``(*B, 1)``."""
        drawn = torch.rand(self.random_delay.shape, generator=self.draws, dtype=torch.double)
        steps = (drawn * (self.random_delay + 1)).floor()
        self.steps = torch.cat([steps, self.steps[..., :-1]], -1)
        has_arrived = self.steps <= torch.arange(self.steps.shape[-1])
        return has_arrived.int().argmax(-1, keepdim=True)
