"""Knowledge-based neural ordinary differential equations."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Literal

import torch
from torch import Tensor, nn

from afm_rl.dynamics.base import DynamicsModel, PerMissionModel, closed_form, jacobian_of_linearised
from afm_rl.dynamics.quadrotor import HeldFlight, Quadrotor
from afm_rl.dynamics.rates import HeldFunction, HeldRate, runge_kutta, runge_kutta_linearised
from afm_rl.dynamics.residual import HeldHybrid, Network, draw_network, network_shapes
from afm_rl.errors import ConfigurationError, check_indices
from afm_rl.options import Count, Natural, Positive, options


class KNODE(PerMissionModel):
    r"""Known dynamics plus a pool of small networks (Jiahao et al. 2021, 2022).

    .. math:: x' = f(x, u) + \sum_{i=0}^{P-1} e^{-i}\,N_i([x; u]),\qquad
              N(z) = \tanh(z W_1 + b_1) W_2 + b_2

    integrated over one control tick by Runge-Kutta steps, with constant action. Network 0 is the
    newest; unused places hold zeros. Only the newest network learns; the others have no gradients.
    :meth:`push_` adds a network in front and removes the oldest.

    In the axes of a quadrotor's body the effect of a lost mass or a weak motor does not change
    while the body turns, so networks that saw it for a moment predict it for a whole plan.

    Parameters are stacked, ``(*L, P, in, out)``. :meth:`expand_` gives every mission its
    own pool.

    Args:
        nominal: the known dynamics f, which also gives ``noise_scale``.
        rate: f as a function, ``rate(state, action) -> (*B, S)``; None for a
            :class:`~afm_rl.dynamics.Quadrotor`, whose equations are known.

    Raises:
        ConfigurationError: without ``dt`` or ``rate``, for ``frame="body"`` of another model, or
            features that are no indices.

    >>> model = KNODE(Quadrotor()).push_()
    >>> level = torch.zeros(4, 13).index_fill(1, torch.tensor(9), 1.0)
    >>> ahead, by_state, by_action = model.linearise(level, torch.zeros(4, 4))
    >>> ahead.shape, by_state.shape, by_action.shape
    (torch.Size([4, 13]), torch.Size([4, 13, 13]), torch.Size([4, 13, 4]))
    """

    shares: Tensor

    @options("dynamics")
    def __init__(
        self,
        nominal: DynamicsModel,
        rate: Callable[[Tensor, Tensor], Tensor] | None = None,
        dt: Annotated[Positive | None, "control tick, s; None: that of the nominal model"] = None,
        units: Annotated[Count, "units of each network"] = 64,
        pool: Annotated[
            Count, "largest number of networks, P; the newest has the largest weight"
        ] = 3,
        features: Annotated[
            Sequence[Natural] | None, "coordinates that networks read; None: all"
        ] = None,
        substeps: Annotated[Count, "Runge-Kutta steps per control tick"] = 1,
        frame: Annotated[
            Literal["body", "world"],
            "axes of the networks' accelerations; body: those of the body; world: as published",
        ] = "world",
        seed: Annotated[Natural, "seed of networks that the model initialises"] = 0,
    ) -> None:
        super().__init__(nominal.manifold, nominal.action_size)
        self.nominal = nominal
        self.hold = _held_rate_of(nominal, rate)
        given = getattr(nominal, "dt", None) if dt is None else dt
        if given is None:
            raise ConfigurationError(
                f"dynamics.dt=None: {type(nominal).__name__} has no dt, give the control tick (s)"
            )
        self.dt, self.units, self.pool, self.substeps = given, units, pool, substeps
        self.turned = frame == "body"
        if self.turned and not isinstance(nominal, Quadrotor):
            raise ConfigurationError(
                f"dynamics.frame={frame!r}: expected 'world'; only a Quadrotor has a body to turn "
                f"with, got {type(nominal).__name__}"
            )
        size = self.state_size
        chosen = range(size) if features is None else features
        self.features = check_indices("dynamics.features", chosen, size)
        self._generator = torch.Generator().manual_seed(seed)
        sizes = len(self.features) + self.action_size, self.units, size
        for name, shape in zip(Network._fields, network_shapes(*sizes), strict=True):
            self.register_parameter(name, nn.Parameter(torch.zeros(self.pool, *shape)))
        shares = torch.exp(-torch.arange(self.pool, dtype=torch.float64))
        self.register_buffer("shares", shares, persistent=False)

    def _owned(self) -> list[tuple[nn.Module, str]]:
        return [(self, name) for name in Network._fields]

    @property
    def networks(self) -> Network:
        """The parameters: all networks of the pool, the newest first, ``(*L, P, ...)``."""
        return Network(*(self.get_parameter(name) for name in Network._fields))

    def draw(self, numbers: Tensor) -> Network:
        """Make new networks from standard normal numbers ``(*L, numbers)``.

        See :func:`~afm_rl.dynamics.residual.draw_network`.
        """
        return draw_network(numbers[..., : self.numbers], *self._sizes)

    @property
    def numbers(self) -> int:
        """Number of random numbers of a network."""
        inputs, hidden, outputs = self._sizes
        return hidden * (inputs + outputs)

    @torch.no_grad()
    def push_(self, network: Network | None = None, where: Tensor | None = None) -> KNODE:
        """Add a network as the newest, in place; a full pool loses the oldest.

        Args:
            network: tensors ``(*L, in, hidden)`` and so on, or without L, the same for all
                missions; if None, one from the model's own generator.
            where: the missions that receive it, boolean ``(*L)``; None for all.
        """
        if network is None:
            network = self.draw(torch.randn(self.numbers, generator=self._generator))
        for parameter, value in zip(self.networks, self._pushed(network), strict=True):
            if where is not None:
                value = torch.where(where[..., None, None, None], value, parameter)
            parameter.data = value.detach()
            parameter.grad = None
        return self

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        return self.advance(state, action, self.dt, self.substeps)

    def advance(
        self,
        state: Tensor,
        action: Tensor,
        dt: float,
        substeps: int = 1,
        newest: Network | None = None,
    ) -> Tensor:
        """Return the states after some time, with constant action.

        Args:
            state: ``(*L, *N, S)``.
            action: ``(*L, *N, A)``.
            dt: time (s).
            substeps: Runge-Kutta steps.
            newest: a network that counts as pushed; None for the pool as it is.

        Returns:
            ``(*L, *N, S)``.
        """
        rows, held, batch = self._held(state, action, newest)
        ahead = held.finish(runge_kutta(held, rows, dt, substeps))
        return ahead.reshape(*batch, self.state_size)

    def slope(self, state: Tensor, action: Tensor, newest: Network | None = None) -> Tensor:
        """Return the derivative of the rate of change by the state, ``(*L, *N, S, S)``."""
        rows, held, batch = self._held(state, action, newest)
        size = self.state_size
        eye = torch.eye(size, size + self.action_size, dtype=rows.dtype, device=rows.device)
        slope = held.tangent(rows, eye.expand(*rows.shape[:-1], *eye.shape))[1]
        return slope[..., :size].reshape(*batch, size, size)

    @closed_form
    def linearise(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rows, held, batch = self._held(state, action, None)
        found = runge_kutta_linearised(held, rows, self.action_size, self.dt, self.substeps)
        ahead, by_state, by_action = (part.reshape(*batch, *part.shape[2:]) for part in found)
        return ahead, by_state, by_action

    def jacobian(self, state: Tensor, action: Tensor) -> Tensor:
        return jacobian_of_linearised(self, state, action)

    def standardise(self, change: Tensor) -> Tensor:
        return self.nominal.standardise(change)

    def noise_scale(self, state: Tensor, action: Tensor) -> Tensor:
        return self.nominal.noise_scale(state, action)

    @property
    def _sizes(self) -> tuple[int, int, int]:
        """Sizes of input, hidden layer and output of each network."""
        return len(self.features) + self.action_size, self.units, self.state_size

    def _pushed(self, network: Network) -> Network:
        """Return the pool ``(*L, P, ...)`` as it is when ``network`` is the newest."""
        pools = []
        for new, old in zip(network, self.networks, strict=True):
            first = new.to(old).expand(*self.lead, *old.shape[-2:]).unsqueeze(-3)
            pools.append(torch.cat([first, old[..., :-1, :, :]], -3))
        return Network(*pools)

    def _merged(self, newest: Network | None, like: Tensor) -> Network:
        """Return the pool as one network per mission, ``(l, in, P * hidden)`` and so on."""
        pool = self.networks if newest is None else self._pushed(newest)
        parts = []
        for part in pool:
            if torch.is_grad_enabled():  # only the newest learns
                part = torch.cat([part[..., :1, :, :], part[..., 1:, :, :].detach()], -3)
            parts.append(part.to(like).reshape(math.prod(self.lead), *part.shape[-3:]))
        inner, inner_bias, outer, outer_bias = parts
        shares = self.shares.to(like)[:, None, None]
        return Network(
            inner.transpose(1, 2).flatten(2),
            inner_bias.transpose(1, 2).flatten(2),
            (outer * shares).flatten(1, 2),
            (outer_bias * shares).sum(1),
        )

    def _held(
        self, state: Tensor, action: Tensor, newest: Network | None
    ) -> tuple[Tensor, HeldHybrid, torch.Size]:
        """Return states ``(l, n, S)``, l = prod(L), their rate, and ``(*L, *N)``."""
        batch = torch.broadcast_shapes(state.shape[:-1], action.shape[:-1])
        lead = self.lead
        self._check_lead(batch)
        dtype = torch.promote_types(state.dtype, action.dtype)
        missions = math.prod(lead)
        each = math.prod(batch[len(lead) :])
        state, action = (
            given.expand(*batch, size).to(dtype).reshape(missions, each, size)
            for given, size in ((state, self.state_size), (action, self.action_size))
        )
        whole = len(self.features) == self.state_size
        network = self._merged(newest, state)
        features = None if whole else self.features
        held = HeldHybrid(self.hold(action), network, action, features, self.turned)
        return state, held, batch


def _held_rate_of(
    nominal: DynamicsModel, rate: Callable[[Tensor, Tensor], Tensor] | None
) -> Callable[[Tensor], HeldRate]:
    """Return what gives the rate of change of a nominal model under an action."""
    if rate is not None:
        return partial(HeldFunction, function=rate, manifold=nominal.manifold)
    if isinstance(nominal, Quadrotor):
        return partial(HeldFlight, body=nominal.body)
    raise ConfigurationError(
        f"dynamics.rate=None: expected the rate of change of {type(nominal).__name__}; only that "
        "of a Quadrotor is known"
    )
