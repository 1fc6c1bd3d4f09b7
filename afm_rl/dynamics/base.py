"""The contract that every dynamics model keeps, alone or with parameters for each mission."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from afm_rl.dynamics.rates import derivative, linearised, pushed_forward
from afm_rl.errors import ConfigurationError, check_count
from afm_rl.spaces.manifold import Manifold

FOLLOWS = {
    "forecast": ("forward", "noise_scale"),
    "rollout": ("forward",),
    "jacobian": ("forward",),
    "linearise": ("forward",),
}
"""Which methods of a model follow from which others."""

Method = TypeVar("Method", bound=Callable[..., Any])


def closed_form(method: Method) -> Method:
    """Mark one of :data:`FOLLOWS` that does not call ``forward``, but agrees with it.

    A subclass that overrides ``forward`` has the general form of :class:`DynamicsModel` instead.
    """
    method.closed_form = True  # type: ignore[attr-defined]
    return method


class DynamicsModel(nn.Module, ABC):
    r"""One-step dynamics :math:`s_{t+1} = f_\theta(s_t, a_t)`, batched.

    ``forward`` takes states ``(*L, *N, S)`` and actions ``(*L, *N, A)``. ``L`` are the
    leading dimensions of missions that own parameters (:attr:`lead`, empty for a shared
    model); ``N`` is any number of further dimensions, such as candidates. The random part of
    the prediction is described by :meth:`moments`, for losses, and :meth:`noise_scale`, for
    gates that judge whether an error is large.

    A subclass, also of a model of this library, may override only ``forward`` or ``noise_scale``:
    derivatives, rollouts and forecasts follow.

    Args:
        manifold: the state space.
        action_size: number of action components, A.
    """

    taught_in: int | None = None
    """Number of the process in which an updater changes the model; None: it stays as it is."""

    affine: bool = False
    """Whether the next state is affine in the action: one Gauss-Newton step inverts it."""

    stiff: bool = False
    """Whether rounding to single precision matters: contacts and stiff joints magnify it."""

    extrapolates: bool = False
    """Whether it predicts actions beyond their box: equations do, networks do not."""

    keeps_derivative: bool = False
    """Whether a correction remembers the derivative by the action, which takes long to compute."""

    skips_nan: bool = False
    """Whether actions of NaN take no time: then only what is of interest is asked for."""

    home: Tensor | None = None
    """Action at rest, such as the pose of position servos, ``(A,)``; None: zero."""

    conditioned_on: str | None = None
    """What an updater sets in it: ``regime``, ``calibration``, or nothing."""

    def __init_subclass__(cls, **settings: Any) -> None:
        """Replace closed forms of methods that a subclass overrides by the general ones."""
        super().__init_subclass__(**settings)
        depth = {
            name: next(k for k, base in enumerate(cls.__mro__) if name in vars(base))
            for name in ("forward", "noise_scale", *FOLLOWS)
        }
        for name, sources in FOLLOWS.items():
            inherited = depth[name] > min(depth[source] for source in sources)
            if inherited and hasattr(getattr(cls, name), "closed_form"):
                setattr(cls, name, getattr(DynamicsModel, name))

    def __init__(self, manifold: Manifold, action_size: int) -> None:
        super().__init__()
        self.manifold = manifold
        self.action_size = check_count("dynamics.action_size", action_size)

    @property
    def state_size(self) -> int:
        """Number of state coordinates, S."""
        return self.manifold.size

    @property
    def lead(self) -> torch.Size:
        """Leading mission dimensions of the parameters."""
        return torch.Size(())

    @abstractmethod
    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the expected next state ``(*L, *N, S)``."""

    def moments(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log-variance ``(*L, *N, M, D)`` of the standardised state change.

        ``M`` counts ensemble members, 1 for a single model, whose variance is one. The
        scale depends on the model: use mean and log-variance only with :meth:`standardise`.
        """
        mean = self.standardise(self.manifold.difference(self(state, action), state))
        return mean.unsqueeze(-2), torch.zeros_like(mean).unsqueeze(-2)

    def standardise(self, change: Tensor) -> Tensor:
        """Express a state change ``(*B, D)`` in the units of :meth:`moments`."""
        return change

    @abstractmethod
    def noise_scale(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the predicted standard deviation ``(*L, *N, D)`` of the state change."""

    def forecast(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return expected next state and noise scale together, in one pass if possible."""
        return self(state, action), self.noise_scale(state, action)

    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        """Return the states ``(*B, N, H, S)`` of plans.

        Computed step by step; models that simulate a plan at once override it.

        Args:
            state: the first state of all plans, ``(*B, S)``.
            actions: plans of H steps, ``(*B, N, H, A)``.
        """
        now, states = state.unsqueeze(-2).expand(*actions.shape[:-2], -1), []
        for action in actions.unbind(-2):
            now = self(now, action)
            states.append(now)
        return torch.stack(states, -2)

    def jacobian(self, state: Tensor, action: Tensor) -> Tensor:
        r"""Return :math:`\partial f / \partial a` ``(*L, *N, D, A)`` on the tangent space.

        Forward differentiation, all action axes in one batch; models with a closed form
        override this.
        """
        axes = torch.eye(self.action_size, device=action.device, dtype=action.dtype)
        before, act = (
            part.unsqueeze(-2).expand(*part.shape[:-1], len(axes), -1).contiguous()
            for part in (state.expand(*action.shape[:-1], -1), action)
        )

        def change(act: Tensor) -> Tensor:
            return self.manifold.difference(self(before, act), before)

        _, columns = derivative(change, (act,), (axes.expand_as(act),))
        # Torch differentiates single numbers times Python's in double precision.
        return columns.mT.to(action.dtype)

    def linearise(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        r"""Return the next state and its derivatives by state and action.

        .. math:: f(s + ds, a + da) \approx f(s, a) + A\,ds + B\,da

        In raw coordinates, also if the manifold has angles or rotations. Forward
        differentiation of all S + A columns in one batch; models with a closed form override it.

        Returns:
            f ``(*L, *N, S)``, A ``(*L, *N, S, S)`` and B ``(*L, *N, S, A)``.
        """
        return linearised(self, state, action)

    def expand_(self, missions: int) -> DynamicsModel:
        """Give each of ``missions`` its own parameters, in place.

        A model without learnable parameters does not change.
        """
        return self

    def select_(self, index: Tensor) -> DynamicsModel:
        """Keep only the missions in ``index``, in place (see :meth:`expand_`)."""
        return self


def jacobian_of_linearised(model: DynamicsModel, state: Tensor, action: Tensor) -> Tensor:
    """Return :meth:`DynamicsModel.jacobian` of a model with a closed :meth:`~.linearise`."""
    ahead, _, by_action = model.linearise(state, action)
    origin = state.unsqueeze(-2)
    return pushed_forward(lambda s: model.manifold.difference(s, origin), ahead, by_action)[1]


Self = TypeVar("Self", bound="PerMissionModel")


class PerMissionModel(DynamicsModel):
    """A dynamics model whose parameters can have a leading dimension of missions.

    Subclasses name these parameters and buffers in :meth:`_owned`.

    :attr:`missions` holds the numbers of the missions that are left, ``(l)``; () while all share
    one model. Code that remembers something of single missions compares it with this.
    """

    missions: Tensor

    def __init__(self, manifold: Manifold, action_size: int) -> None:
        super().__init__(manifold, action_size)
        self.register_buffer("missions", torch.zeros((), dtype=torch.int64), persistent=False)

    @property
    def lead(self) -> torch.Size:
        return self.missions.shape

    @abstractmethod
    def _owned(self) -> Iterable[tuple[nn.Module, str]]:
        """Return the parameters and buffers of missions: the module and the name in it."""

    def expand_(self: Self, missions: int) -> Self:
        if self.lead:
            raise ConfigurationError(f"dynamics: already expanded to {tuple(self.lead)} missions")
        self._replace_owned(lambda part: part.expand(missions, *part.shape).clone())
        self.missions = torch.arange(missions, device=self.missions.device)
        return self

    def select_(self: Self, index: Tensor) -> Self:
        """Keep the missions in ``index``, in place; a shared model stays as it is."""
        if self.lead:
            self._replace_owned(lambda part: part[index])
            self.missions = self.missions[index]
        return self

    def _replace_owned(self, change: Callable[[Tensor], Tensor]) -> None:
        for owner, name in self._owned():
            part = getattr(owner, name)
            if isinstance(part, nn.Parameter):  # optimisers hold it: only its data may change
                part.data, part.grad = change(part.data), None
            else:
                setattr(owner, name, change(part))

    def _check_lead(self, batch: torch.Size) -> None:
        """Refuse a batch that does not begin with the missions."""
        lead = self.lead
        if batch[: len(lead)] != lead:
            raise ConfigurationError(
                f"dynamics: the model holds {tuple(lead)} missions, got a batch of shape "
                f"{tuple(batch)}; expected ({', '.join(map(str, lead))}, ...)"
            )


class UnknownDynamics(DynamicsModel):
    """The sizes of an unknown model; every prediction raises an error.

    >>> from afm_rl.spaces.manifold import Manifold
    >>> UnknownDynamics(Manifold(3), action_size=2).state_size
    3
    """

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Raise a :class:`~afm_rl.errors.ConfigurationError`."""
        raise ConfigurationError(
            "robot.model: the physics of this robot are not known; choose dynamics=pe, which "
            "learns from the robot's own transitions (method=frozen_pe, afm_frozen_pe, ...), or "
            "give a model"
        )

    def noise_scale(self, state: Tensor, action: Tensor) -> Tensor:
        return self(state, action)
