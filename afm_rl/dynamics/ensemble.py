"""The probabilistic ensemble."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Annotated, Literal

import torch
import torch.nn.functional as F  # noqa: N812
from annotated_types import Ge, Le, MinLen
from torch import Tensor, nn

from afm_rl.compiling.devices import CastCache
from afm_rl.dynamics.base import PerMissionModel, closed_form
from afm_rl.dynamics.stacked import (
    RunningStats,
    sparse_layer,
    stacked_mlp,
    stacked_mlp_tangent,
    uniform_layer,
)
from afm_rl.errors import ConfigurationError, check_indices
from afm_rl.options import Count, Natural, options
from afm_rl.spaces.manifold import Manifold
from afm_rl.streams import Streams

Stack = Sequence[Tensor]
Parameters = tuple[Iterable[Tensor], Iterable[Tensor]]  # weights and biases, layer by layer
CHUNK = 2**18  # activations per layer and chunk: 1 MiB in float32, so that they stay in cache


class Ensemble(PerMissionModel):
    r"""Probabilistic ensemble of E networks (Chua et al. 2018; paper, section V-B).

    Each member maps the standardised features of state and action to mean and
    log-variance of the standardised state change,
    :math:`(s_{t+1} \ominus s_t - m) / c`. Networks read cosine and sine of every angle and the
    matrix of a rotation (:meth:`Manifold.encode <afm_rl.spaces.manifold.Manifold.encode>`).

    The prediction is the mean over members of their means (``propagation="mean"``), or of one
    sample each (``"sample"``, as published).

    ``propagation`` and ``precision`` apply only to :meth:`forward`. Losses, errors and Jacobians
    always use the whole ensemble in the precision of its parameters. The same precision is used
    if gradients are recorded, and in the first and last layer. States and actions may have another
    precision, which the predicted states keep.

    Parameters are stacked, ``(*L, E, in, out)``: no loop over members. :meth:`expand_`
    gives every mission its own copy to learn with.

    Args:
        manifold: state space.
        action_size: number of action components, A.
        features: indices of the state coordinates that the dynamics depend on.

    Raises:
        ConfigurationError: for features that are no indices, or bounds of the log-variance that
            are not low < high.

    >>> model = Ensemble(Manifold(3, angles=[2]), 2, features=[2], hidden=[16])
    >>> model(torch.zeros(7, 3), torch.zeros(7, 2)).shape
    torch.Size([7, 3])
    """

    input_mean: Tensor
    input_std: Tensor
    target_mean: Tensor
    target_std: Tensor

    @options("dynamics")
    def __init__(
        self,
        manifold: Manifold,
        action_size: int,
        features: Sequence[int],
        members: Annotated[Count, Le(1000), "networks, E"] = 5,
        hidden: Annotated[Sequence[Count], Le(10_000), MinLen(1), "layer sizes"] = (200, 200, 200),
        log_variance: Annotated[Sequence[float], "soft bounds, standardised units"] = (-10.0, 0.5),
        propagation: Annotated[
            Literal["mean", "sample"],
            "mean: of all means; sample: one of each member, as published",
        ] = "mean",
        seed: Annotated[Natural, "seed of the initial weights"] = 0,
        init: Annotated[
            Literal["uniform", "sparse"], "sparse: nine tenths of the weights are zero"
        ] = "uniform",
        layer_norm: Annotated[bool, "standardise a layer's units before each LeakyReLU"] = False,
        running_count: Annotated[
            int | None,
            Ge(2),
            "number of samples that pre-training counts as; None: constant statistics",
        ] = None,
        precision: Annotated[
            Literal["float32", "bfloat16"],
            "precision of hidden layers in rollouts; bfloat16: faster where supported",
        ] = "float32",
        encode: Annotated[
            bool, "read cosines and sines of angles; False: angles, as published"
        ] = True,
    ) -> None:
        super().__init__(manifold, action_size)
        self.features = check_indices("dynamics.features", features, manifold.size)
        self.members, self.hidden = members, list(hidden)
        if len(log_variance) != 2 or not log_variance[0] < log_variance[1]:
            raise ConfigurationError(f"dynamics.log_variance={log_variance}: expected low < high")
        low, high = log_variance
        self.log_variance = (float(low), float(high))
        self.propagation, self.precision, self.encode = propagation, precision, encode
        self.layer_norm, self._cast = layer_norm, CastCache(torch.bfloat16)
        self.streams, generator = Streams(salt=6, seed=seed), torch.Generator().manual_seed(seed)
        self._encoded_size = self._encoded(torch.zeros(manifold.size)).shape[-1]
        inputs, targets = self._encoded_size + action_size, manifold.tangent_size
        sizes = [inputs, *self.hidden, 2 * targets]
        draw = {"uniform": uniform_layer, "sparse": sparse_layer}[init]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for fan_in, fan_out in zip(sizes[:-1], sizes[1:], strict=True):
            weight, bias = draw(members, fan_in, fan_out, generator)
            self.weights.append(nn.Parameter(weight))
            self.biases.append(nn.Parameter(bias))
        for name, size in (("input", inputs), ("target", targets)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))
        self.running_count, self.running = running_count, None
        if running_count is not None:
            self.running = RunningStats(inputs)

    def _owned(self) -> Iterator[tuple[nn.Module, str]]:
        for group in (self.weights, self.biases):
            for index in range(len(group)):
                yield group, str(index)
        if self.running is not None:
            for name, _ in self.running.named_buffers():
                yield self.running, name

    def normalise_(self, inputs: Tensor, targets: Tensor, rounding: float = 1e-6) -> None:
        """Set the statistics of inputs ``(N, in)`` and state changes ``(N, D)``.

        A constant coordinate keeps its unit, because division by a rounding error would make the
        smallest later difference huge; the prediction of its change starts as the mean. A
        coordinate is constant if it varies by less than ``rounding``, a share of its size.
        """
        for name, data in (("input", inputs), ("target", targets)):
            std = data.std(0)
            still = std <= rounding * data.abs().amax(0).clamp_min(1e-2)
            getattr(self, f"{name}_mean").copy_(data.mean(0))
            getattr(self, f"{name}_std").copy_(std.masked_fill(still, 1.0))
        with torch.no_grad():
            for parameter in (self.weights[-1], self.biases[-1]):
                parameter[..., : still.numel()].masked_fill_(still, 0.0)
        if self.running is not None:
            count = min(len(inputs), self.running_count or 0)
            self.running.start_(self.input_mean, self.input_std, count)

    def observe_(self, state: Tensor, action: Tensor, where: Tensor | None = None) -> None:
        """Update the running statistics, if there are any, with inputs ``(*L, *N)``.

        Args:
            state: ``(*L, *N, S)``.
            action: ``(*L, *N, A)``.
            where: ``(*L, *N)`` boolean, which of them count; None for all.
        """
        if self.running is not None:
            self.running.update_(self.inputs(state, action), where)

    def inputs(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the raw network inputs ``(*B, in)``."""
        return torch.cat([self._encoded(state), action], -1)

    def _encoded(self, state: Tensor) -> Tensor:
        """Return what the networks read of states."""
        if self.encode:
            return self.manifold.encode(state, self.features)
        return state[..., self.features]

    def standardise(self, change: Tensor) -> Tensor:
        """Express a state change in standard deviations of the training data."""
        return (change - self.target_mean) / self.target_std

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        size, parameters = self.manifold.tangent_size, self._planning_parameters()
        if self.propagation == "sample":
            mean, log_variance = self._moments(self._run(state, action, 2 * size, parameters))
            noise = self.streams.normal(mean.shape, device=mean.device, dtype=mean.dtype)
            change = (mean + noise * (0.5 * log_variance).exp()).mean(-2)
        else:
            change = self._run(state, action, size, parameters).mean(-2)
        return self.manifold.add(state, change * self.target_std + self.target_mean)

    def moments(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        parameters = self.weights, self.biases
        return self._moments(self._run(state, action, 2 * self.manifold.tangent_size, parameters))

    def member_moments(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return each member's moments on its own rows: ``(E, N, in)`` in, ``(E, N, D)`` out.

        For training the members of a shared ensemble on different :meth:`network_rows`.
        """
        weights, biases = list(self.weights), list(self.biases)
        return self._moments(stacked_mlp(rows, weights, biases, self.layer_norm))

    def _moments(self, out: Tensor) -> tuple[Tensor, Tensor]:
        """Split raw outputs into mean and softly bounded log-variance."""
        mean, raw = out.chunk(2, -1)
        low, high = self.log_variance
        raw = high - F.softplus(high - raw)
        return mean, low + F.softplus(raw - low)

    def noise_scale(self, state: Tensor, action: Tensor) -> Tensor:
        return Ensemble.forecast(self, state, action)[1]

    @closed_form
    def forecast(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean next state and the mixture's standard deviation in one pass."""
        mean, log_variance = self.moments(state, action)
        variance = log_variance.exp().mean(-2) + mean.var(-2, correction=0)
        change = mean.mean(-2) * self.target_std + self.target_mean
        ahead = self.manifold.add(state, change)
        return ahead, (variance.sqrt() * self.target_std).to(ahead)

    @closed_form
    def jacobian(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the mean Jacobian of the members ``(*L, *N, D, A)``, in closed form."""
        rows, shape = self._rows(state, action)
        axes = torch.eye(rows.shape[-1], device=rows.device, dtype=rows.dtype)
        axes = axes[self._encoded_size :]
        size = self.manifold.tangent_size

        def tangents(wide: Tensor, weights: Stack, biases: Stack) -> Tensor:
            return stacked_mlp_tangent(wide, axes, weights, biases, self.layer_norm)

        std = self.input_std if self.running is None else self.running.std
        std = std[..., self._encoded_size :].reshape(-1, 1, self.action_size, 1)
        parameters = self.weights, self.biases
        moved = self._chunked(tangents, rows, size, parameters).mean(2) / std  # (l, n, A, D)
        moved = (moved * self.target_std).mT.reshape(*shape, size, self.action_size)
        return moved.to(torch.promote_types(state.dtype, action.dtype))

    def _rows(self, state: Tensor, action: Tensor) -> tuple[Tensor, torch.Size]:
        """Return standardised inputs ``(l, n, in)``, l = prod(lead), and ``(*L, *N)``."""
        lead = self.lead
        self._check_lead(state.shape[:-1])
        rows = self.network_rows(state, action)
        return rows.reshape(max(1, math.prod(lead)), -1, rows.shape[-1]), rows.shape[:-1]

    def network_rows(self, state: Tensor, action: Tensor) -> Tensor:
        """Return standardised inputs ``(*L, *N, in)`` in the precision of the networks."""
        raw = self.inputs(state, action)
        if self.running is not None:
            return self.running(raw).to(self.weights[0])
        rows = (raw - self.input_mean) / self.input_std
        return rows.to(self.weights[0])

    def _planning_parameters(self) -> Parameters:
        """Return weights and biases for :meth:`forward`, the hidden layers' in its precision."""
        if self.precision == "float32" or torch.is_grad_enabled():
            return self.weights, self.biases
        weights, biases = list(self.weights), list(self.biases)
        cast = self._cast.of([*weights[1:-1], *biases[1:-1]])
        half = len(cast) // 2
        weights[1:-1], biases[1:-1] = cast[:half], cast[half:]
        return weights, biases

    def _stacked(
        self, missions: slice, size: int, parameters: Parameters
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Return flattened parameters of some missions, the last layer cut to ``size``."""
        stacks = []
        for group in parameters:
            stack = list(group)
            if self.lead:  # a slice of all would cost a copy of all in the backward pass
                cut = missions.stop < self.lead[0] or missions.start > 0
                stack = [(p[missions] if cut else p).flatten(0, 1) for p in stack]
            stack[-1] = stack[-1][..., :size]
            stacks.append(stack)
        return stacks[0], stacks[1]

    def _run(self, state: Tensor, action: Tensor, size: int, parameters: Parameters) -> Tensor:
        """Return the first ``size`` outputs of every member ``(*L, *N, E, size)``."""
        rows, shape = self._rows(state, action)
        network = partial(stacked_mlp, layer_norm=self.layer_norm)
        return self._chunked(network, rows, size, parameters).reshape(*shape, self.members, size)

    def _chunked(
        self,
        network: Callable[[Tensor, Stack, Stack], Tensor],
        rows: Tensor,
        size: int,
        parameters: Parameters,
    ) -> Tensor:
        """Show rows ``(l, n, in)`` to every member; return ``(l, n, E, ...)``."""
        per_row = self.members * max(self.hidden, default=1)
        width = max(1, min(rows.shape[1], CHUNK // per_row))
        height = max(1, CHUNK // (per_row * width))
        pieces = []
        for top in range(0, rows.shape[0], height):
            missions = slice(top, top + height)
            weights, biases = self._stacked(missions, size, parameters)
            wide = rows[missions].unsqueeze(1).expand(-1, self.members, -1, -1).flatten(0, 1)
            parts = [network(part, weights, biases) for part in wide.split(width, 1)]
            pieces.append(torch.cat(parts, 1) if len(parts) > 1 else parts[0])
        out = torch.cat(pieces) if len(pieces) > 1 else pieces[0]
        return out.unflatten(0, (-1, self.members)).transpose(1, 2)
