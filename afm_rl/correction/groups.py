"""Hypotheses of one kind, computed together."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.correction.context_windows import ContextWindows
from afm_rl.correction.experts import Rows, fit_experts
from afm_rl.correction.hypotheses import Hypothesis, acting_of
from afm_rl.correction.least_squares import fit_gain
from afm_rl.correction.linear import Evidence, Line, Map
from afm_rl.correction.network import AxisNetwork, Encoded


class Pairs(NamedTuple):
    """Remembered rows, as the network is given them; the oldest first."""

    rows: Tensor
    """Commands, effects, standard deviations, validity, innovation and place, ``(B, M, D)``."""
    place: Tensor | None
    """Where the robots are, ``(B, G)``; None: all ground is alike."""


class Group(nn.Module, ABC):
    """G hypotheses of one kind: fitted, asked what they expect, and asked about actions.

    Subclasses say how. What they fit are named tuples of tensors ``(B, ...)``.

    Args:
        hypotheses: the rows of the table.
    """

    mixes_axes = False
    """Can a command move other axes?"""

    def __init__(self, hypotheses: Sequence[Hypothesis]) -> None:
        super().__init__()
        self.hypotheses, self.models = hypotheses, len(hypotheses)

    @abstractmethod
    def fit(self, evidence: Evidence, pairs: Pairs) -> Any:
        """Fit all to what is remembered."""

    def expect(self, fit: Any, acts: Tensor) -> Tensor:
        """Return the effects ``(B, G, A)`` that each expects of what acts by it, likewise."""
        return fit.effect(acts.unsqueeze(2)).squeeze(2)

    def likeliest(self, fit: Any, weights: Tensor) -> tuple[Any, Tensor]:
        """Return the ``models``, K of them, of which an action is chosen, and their probabilities.

        Args:
            fit: all of them.
            weights: their probabilities, ``(B, G, A)``.
        """
        return fit, weights

    def forecast(self, fit: Any, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return what the likeliest expect of actions ``(B, C, A)``, and the variances.

        ``(B, K, C, A)`` each; variances are those of the fits, in units of the noise.
        """
        return fit.effect(actions.unsqueeze(1)), fit.variance(actions)


class AsSent(Group):
    """Commands act as they are sent, some day: the plan is the answer."""

    def __init__(self, hypotheses: Sequence[Hypothesis]) -> None:
        super().__init__(hypotheses)
        self.models = 1

    def fit(self, evidence: Evidence, pairs: Pairs) -> Evidence:
        """Return the evidence: these have nothing to fit."""
        return evidence

    def expect(self, fit: Evidence, acts: Tensor) -> Tensor:
        """Return what acts, or what a healthy robot makes of it."""
        effects = [
            command if row.effect is None else row.effect(fit, command).to(command)
            for row, command in zip(self.hypotheses, acts.unbind(1), strict=True)
        ]
        return torch.stack(effects, 1)

    def likeliest(self, fit: Evidence, weights: Tensor) -> tuple[Evidence, Tensor]:
        """Return one for all: none of them is a reason to send another command."""
        return fit, weights.sum(1, keepdim=True)

    def forecast(self, fit: Evidence, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the actions, and that this is sure."""
        actions = actions.unsqueeze(1)
        return actions, torch.zeros_like(actions)


class Lines(Group):
    """Lines, an axis for itself."""

    def fit(self, evidence: Evidence, pairs: Pairs) -> Line:
        """Return all of them."""
        lines = [row.fit(evidence) for row in self.hypotheses if row.fit is not None]
        return Line(*(torch.stack(of_all, 1).to(pairs.rows) for of_all in zip(*lines, strict=True)))


class Maps(Group):
    """Maps that mix axes."""

    mixes_axes = True

    def fit(self, evidence: Evidence, pairs: Pairs) -> Map:
        """Return all of them."""
        maps = [row.fit(evidence) for row in self.hypotheses if row.fit is not None]
        return Map(*(torch.stack(of_all, 1).to(pairs.rows) for of_all in zip(*maps, strict=True)))


class LateGains(Group):
    """Gains of commands that act late, each in its way; the likeliest is a line.

    Args:
        hypotheses: the rows of the table.
        rows: newest ones that are fitted, K.
    """

    acting: Tensor
    windows: Tensor

    def __init__(self, hypotheses: Sequence[Hypothesis], rows: int) -> None:
        super().__init__(hypotheses)
        acting = acting_of(hypotheses).mT  # (L, G)
        self.rows, self.models = rows, 1
        self.register_buffer("acting", acting, persistent=False)
        windows = torch.arange(rows).unsqueeze(-1) + torch.arange(len(acting))
        self.register_buffer("windows", windows, persistent=False)

    def fit(self, evidence: Evidence, pairs: Pairs) -> Line:
        """Return the gain of each, of the commands that act by it, with its variance."""
        newest = evidence.sent[..., 1 - self.rows - len(self.acting) :][..., self.windows]
        acted, last = newest @ self.acting.to(newest), slice(-self.rows, None)  # (B, A, K, G)
        seen = (rows[..., last, None] for rows in (evidence.effect, evidence.weight))
        gain, variance = fit_gain(acted, *seen)  # (B, A, G)
        gain, variance = gain.mT.to(pairs.rows), variance.mT.to(pairs.rows)
        covariance = torch.nn.functional.pad(variance[..., None, None], (1, 0, 1, 0))
        return Line(gain, torch.zeros_like(gain), covariance)

    def likeliest(self, fit: Line, weights: Tensor) -> tuple[Line, Tensor]:
        """Return the one of each axis that is believed most."""
        which = weights.argmax(1, keepdim=True)
        square = which[..., None, None].expand(*which.shape, 2, 2)
        covariance = fit.covariance.gather(1, square)
        chosen = Line(fit.gain.gather(1, which), fit.offset[:, :1], covariance)
        return chosen, weights.sum(1, keepdim=True)


class Windows(Group):
    """The network, given one window of the pairs or another; each axis asks the likeliest.

    Args:
        hypotheses: the rows of the table.
        network: the network.
        rows: of a window, K.
        size: number of actions, A.
    """

    tie_break: Tensor

    def __init__(
        self, hypotheses: Sequence[Hypothesis], network: AxisNetwork, rows: int, size: int
    ) -> None:
        super().__init__(hypotheses)
        self.network, self.models = network, 1
        self.windows = ContextWindows([row.name for row in hypotheses], rows, size)
        # Of windows with equal probability the first, on any machine and in any batch.
        tie_break = 1 - 1e-4 * torch.arange(len(hypotheses)).unsqueeze(-1)
        self.register_buffer("tie_break", tie_break, persistent=False)

    def fit(self, evidence: Evidence, pairs: Pairs) -> Encoded:
        """Return the network's code of each window, B G sets."""
        rows = self.windows(*pairs)
        noise = evidence.noise.to(rows.std)[:, None, None]
        rows = rows._replace(std=torch.hypot(rows.std, noise) * rows.valid)
        rows = Rows(*(column.flatten(0, 1) for column in rows))
        return self.network.encode(rows, fit_experts(rows))

    def expect(self, fit: Encoded, acts: Tensor) -> Tensor:
        """Return the network's forecasts, by each window."""
        return self.network.effect(fit, acts.flatten(0, 1).unsqueeze(1)).view_as(acts)

    def likeliest(self, fit: Encoded, weights: Tensor) -> tuple[Encoded, Tensor]:
        """Return the likeliest window of each axis."""
        if len(self.hypotheses) == 1:
            return fit, weights
        return fit.choose((weights * self.tie_break).argmax(1)), weights.sum(1, keepdim=True)

    def forecast(self, fit: Encoded, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the network's forecasts, and the variances of the fits that it mixes."""
        effect, variance = self.network.forecast(fit, actions)
        return effect.unsqueeze(1), variance.unsqueeze(1)
