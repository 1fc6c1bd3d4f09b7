"""The network of the action flow: one for robots with any number of actions."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from importlib.resources import files
from typing import NamedTuple

import torch
from safetensors.torch import load
from torch import Tensor, nn

from afm_rl.correction.achievable import LIMIT, MODES
from afm_rl.correction.experts import (
    ANSWERS,
    EXPERTS,
    LEAST_MISS,
    MISSES,
    Experts,
    Rows,
)
from afm_rl.errors import ArtefactError, check_count

SHARPNESS = 5.0  # of the logits of a mixture: shares of all or nothing are soon learnt
LEAST_TIME = 0.1  # of the path that is left, in the velocity towards an expert's answer
CELL = 5 + MISSES  # features of a cell
FILE = "universal.safetensors"

Velocity = Callable[[float, Tensor], Tensor]


def mlp(
    sizes: Sequence[int], generator: torch.Generator, activation: type[nn.Module] = nn.ReLU
) -> nn.Sequential:
    """Return a perceptron with an activation between its layers.

    The initial weights are those of ``nn.Linear``, but drawn from ``generator``.

    >>> mlp([3, 8, 2], torch.Generator())[-1].out_features
    2
    """
    layers: list[nn.Module] = []
    for fan_in, fan_out in zip(sizes[:-1], sizes[1:], strict=True):
        linear = nn.utils.skip_init(nn.Linear, fan_in, fan_out)
        for parameter in linear.parameters():
            bound = 1 / math.sqrt(fan_in)
            nn.init.uniform_(parameter, -bound, bound, generator=generator)
        layers += [linear, activation()]
    return nn.Sequential(*layers[:-1])


class Encoded(NamedTuple):
    """What the network reads in N sets of rows, to be asked about actions."""

    experts: Experts
    """The experts' fits."""
    code: Tensor
    """A code per axis, ``(N, A, 1, L)``."""
    effect: Tensor
    """Its part in the first layer about effects, ``(N, A, 1, W)``."""

    def choose(self, which: Tensor) -> Encoded:
        """Return one model of B missions, axis by axis from the R sets of rows that each has.

        Args:
            which: the set that an axis reads, ``(B, A)``; N is B R.
        """
        count, axes = which.shape
        row = torch.arange(count, device=which.device).unsqueeze(-1)
        at = row * (self.code.shape[0] // count) + which
        axis = torch.arange(axes, device=which.device)
        parts = {name: part[at, axis] for name, part in self.experts._asdict().items()}
        return Encoded(Experts(**parts), self.code[at, axis], self.effect[at, axis])


class Asked(NamedTuple):
    """Plans, as the velocity reads them."""

    hidden: Tensor
    """Their part in the first layer, ``(N, A, C, W)``."""
    answers: Tensor
    """The experts' answers, ``(N, A, C, 6)``."""


class AxisNetwork(nn.Module):
    r"""Velocity and effect of actions under a regime that a set of pairs describes.

    The same weights serve every axis, so any number of axes A will do, in any order: a cell for
    every (row, axis) is embedded; attention over the rows pools an axis's cells into its code; the
    codes of the other axes join it once (mean and maximum). Two heads answer per axis, each with a
    mixture of experts (Jacobs et al. 1991) and of an answer of its own:

    .. math:: y = s_0\,y_\mathrm{own} + \sum_e s_e\,y_e,\qquad s = \mathrm{softmax}(5 \ell)

    which is exact where an expert is, as no network of this size is by itself. All actions are
    shares of the largest one.

    Args:
        width: units of the heads' hidden layers.
        latent: size of an axis's code.
        across: False lets no axis see the others' codes (for ablations).
        experts: False lets the heads answer by themselves alone (for ablations).
        noise: False hides the standard deviations of the pairs (for ablations).
        seed: of the initial weights.

    >>> from afm_rl.correction.experts import fit_experts
    >>> u = torch.rand(1, 12, 3)
    >>> rows = Rows(u, -u, torch.zeros(1, 12, 3), torch.ones(1, 12, 1))
    >>> network = AxisNetwork()
    >>> encoded = network.encode(rows, fit_experts(rows))
    >>> network.effect(encoded, torch.rand(1, 5, 3)).shape  # of five actions
    torch.Size([1, 5, 3])
    """

    modes: Tensor

    def __init__(
        self,
        width: int = 64,
        latent: int = 64,
        across: bool = True,
        experts: bool = True,
        noise: bool = True,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.across, self.experts, self.noise = across, experts, noise
        generator = torch.Generator().manual_seed(seed)
        self.cell = mlp([CELL, latent // 2, latent], generator)
        self.query = mlp([latent, 1], generator)
        self.pooled = mlp([2 * latent, latent], generator)
        self.mixed = mlp([3 * latent, latent, latent], generator)
        self.plan_code = mlp([latent, width], generator)
        self.plan_query = mlp([ANSWERS + MISSES + len(MODES) + 1, width], generator)
        self.point_weight = nn.Parameter(torch.randn(width, generator=generator))
        self.time_weight = nn.Parameter(torch.randn(width, generator=generator))
        self.plan_head = mlp([width, width, EXPERTS + 2], generator)
        self.effect_code = mlp([latent, width], generator)
        self.effect_query = mlp([ANSWERS + MISSES + 1, width], generator)
        self.effect_head = mlp([width, width, EXPERTS + 2], generator)
        self.register_buffer("modes", torch.eye(len(MODES)), persistent=False)

    def encode(self, rows: Rows, experts: Experts) -> Encoded:
        """Read N sets of rows ``(N, K, A)`` and the experts' fits of them."""
        valid = rows.valid.to(self.modes.dtype).unsqueeze(1)  # (N, 1, K, 1)
        cells = self.cell(self._cells(rows, experts)).relu()
        logits = self.query(cells) + (valid - 1) * 1e4
        mean = valid / valid.sum(-2, keepdim=True).clamp_min(1.0)
        pool = torch.cat([logits.softmax(-2), mean.expand_as(logits)], -1)
        code = self.pooled((pool.mT @ cells).flatten(-2)).relu()  # (N, A, L)
        if self.across:
            others = torch.cat([code.mean(-2, keepdim=True), code.amax(-2, keepdim=True)], -1)
            code = code + self.mixed(torch.cat([code, others.expand(*code.shape[:-1], -1)], -1))
        code = code.unsqueeze(-2)
        return Encoded(experts, code, self.effect_code(code))

    def ask(self, encoded: Encoded, planned: Tensor, mode: str) -> Asked:
        """Read plans ``(N, C, A)``; ``mode`` says how those that cannot be had are saturated."""
        answers = encoded.experts.execute(planned, mode)
        which = self.modes[MODES.index(mode)]
        given = [planned.mT.unsqueeze(-1), answers, encoded.experts.misses, which]
        shape = (*answers.shape[:-1], -1)
        asked = torch.cat([part.expand(shape) for part in given], -1)
        hidden = self.plan_code(encoded.code) + self.plan_query(asked)
        return Asked(hidden, answers[..., :EXPERTS])

    def velocity(self, asked: Asked, tau: Tensor | float, point: Tensor) -> Tensor:
        """Return the velocity at points ``(N, C, A)`` of the path, the same shape.

        Args:
            asked: the plans, C of them, or one for all points.
            tau: time on the path, one number or ``(N, C, 1)``.
            point: x at that time.
        """
        at = point.mT.unsqueeze(-1)
        time: Tensor | float
        left: Tensor | float
        if isinstance(tau, Tensor):
            time = tau.mT.unsqueeze(-1)
            left = (1 - time).clamp_min(LEAST_TIME)
        else:
            time, left = tau, max(1 - tau, LEAST_TIME)
        hidden = asked.hidden + at * self.point_weight + time * self.time_weight
        own, shares = self._mixture(self.plan_head(hidden.relu()))
        return self._mean(shares, own, (asked.answers - at) / left)

    def effect(self, encoded: Encoded, executed: Tensor) -> Tensor:
        """Return the effects ``(N, C, A)`` that actions ``(N, C, A)`` are predicted to have."""
        answers, own, shares = self._read(encoded, executed)
        return self._mean(shares, own, answers[..., :EXPERTS])

    def forecast(self, encoded: Encoded, executed: Tensor) -> tuple[Tensor, Tensor]:
        """Return the effects of actions ``(N, C, A)``, and their variances in units of the noise.

        Those of the fits that are mixed; the own answer is as sure as the line. ``(N, C, A)`` each.
        """
        answers, own, shares = self._read(encoded, executed)
        variances = encoded.experts.variance(executed, answers[..., EXPERTS:])
        line = variances[..., MISSES - 1 : MISSES]
        effect = self._mean(shares, own, answers[..., :EXPERTS])
        return effect, self._mean(shares, line, variances)

    def _read(self, encoded: Encoded, executed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the experts' answers about actions, the own one, and the shares of all."""
        answers = encoded.experts.effect(executed)
        misses = encoded.experts.misses.expand(*answers.shape[:-1], -1)
        asked = torch.cat([executed.mT.unsqueeze(-1), answers, misses], -1)
        hidden = (encoded.effect + self.effect_query(asked)).relu()
        return answers, *self._mixture(self.effect_head(hidden))

    def _mean(self, shares: Tensor, own: Tensor, experts: Tensor) -> Tensor:
        """Return the mean ``(N, C, A)`` of the own answer and of the experts'."""
        return (shares * torch.cat([own, experts], -1)).sum(-1).mT

    def _mixture(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """Return the own answers ``(N, A, C, 1)``, and the shares of these and of the experts."""
        own, logits = output.split([1, EXPERTS + 1], -1)
        if self.experts:
            return own, (SHARPNESS * logits).softmax(-1)
        return own, torch.nn.functional.pad(torch.ones_like(own), (0, EXPERTS))

    def _cells(self, rows: Rows, experts: Experts) -> Tensor:
        """Return the features of every axis and row, ``(N, A, K, F)``."""
        executed, effective, std, valid = (part.mT for part in rows)
        loud = (std + LEAST_MISS).log() if self.noise else torch.zeros_like(std)
        age = torch.linspace(1.0, 0.0, executed.shape[-1], device=std.device, dtype=std.dtype)
        own = [executed, effective, loud, age.expand_as(std), valid.expand_as(std)]
        left = experts.residuals.clamp(-LIMIT, LIMIT)
        features = torch.cat([torch.stack(own, -1), left], -1) * valid.unsqueeze(-1)
        return features.to(self.modes.dtype)


def midpoint(velocity: Velocity, start: Tensor, steps: int) -> Tensor:
    r"""Integrate :math:`\dot x = v(\tau, x)` from 0 to 1 with the explicit midpoint rule.

    .. math:: x_{\tau+h} = x_\tau + h\, v(\tau + h/2,\; x_\tau + \tfrac h2 v(\tau, x_\tau))

    Second order: half the step, a quarter of the error.

    Args:
        velocity: v, takes the time and the point.
        start: x_0, ``(*B, A)``.
        steps: number of equal steps.

    Raises:
        ConfigurationError: if ``steps`` is no whole number above 0.

    >>> x = midpoint(lambda tau, x: x, torch.ones(1), 100)
    >>> abs(float(x) - 2.718281828) < 1e-4
    True
    """
    check_count("corrector.steps", steps)
    step, point = 1.0 / steps, start
    for k in range(steps):
        tau = k * step
        half = point + 0.5 * step * velocity(tau, point)
        point = point + step * velocity(tau + 0.5 * step, half)
    return point


def load_universal() -> AxisNetwork:
    """Return the universal network, frozen.

    Raises:
        ArtefactError: if the file does not have the checksum that is written beside it.
    """
    folder = files("afm_rl.correction")
    data = folder.joinpath(FILE).read_bytes()
    expected = folder.joinpath(f"{FILE}.sha256").read_text().split()[0]
    if hashlib.sha256(data).hexdigest() != expected:
        raise ArtefactError(
            f"{FILE}: damaged, its checksum is not {expected}: install afm-rl again"
        )
    network = AxisNetwork()
    network.load_state_dict(load(data))
    return network.requires_grad_(False).eval()
