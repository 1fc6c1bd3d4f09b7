"""The contract that every dynamics model keeps."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from afm_rl.dynamics.derivatives import derivative, linearised, pushed_forward
from afm_rl.errors import check_count
from afm_rl.spaces.manifold import Manifold


class DynamicsModel(nn.Module, ABC):
    r"""One-step dynamics :math:`s_{t+1} = f_\theta(s_t, a_t)`, batched.

    ``forward`` takes states ``(*L, *N, S)`` and actions ``(*L, *N, A)``. ``L`` are the
    leading dimensions of missions that own parameters (:attr:`lead`, empty for a shared
    model); ``N`` is any number of further dimensions, such as candidates. The random part of
    the prediction is described by :meth:`moments`, for losses, and :meth:`noise_scale`, for
    gates that judge whether an error is large.

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

    conditioned_on: str | None = None
    """What an updater sets in it: ``regime``, ``calibration``, or nothing."""

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

    @abstractmethod
    def moments(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log-variance ``(*L, *N, M, D)`` of the standardised state change.

        ``M`` counts ensemble members, 1 for a single model. Only mean, log-variance and
        :meth:`standardise` together mean something: the scale is the model's own.
        """

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
        """Return the states ``(*B, N, H, S)`` that whole plans lead to.

        Step by step; models that simulate a plan at once override it.

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

        In raw coordinates, also where the manifold has angles or rotations. Forward
        differentiation of all S + A columns in one batch; models with a closed form override it.

        Returns:
            f ``(*L, *N, S)``, A ``(*L, *N, S, S)`` and B ``(*L, *N, S, A)``.
        """
        return linearised(self, state, action)

    def expand_(self, missions: int) -> DynamicsModel:
        """Give each of ``missions`` parameters of its own, in place.

        A model without learnable parameters has nothing to give and stays as it is.
        """
        return self

    def select_(self, index: Tensor) -> DynamicsModel:
        """Keep the missions in ``index`` only, in place (see :meth:`expand_`)."""
        return self


def jacobian_of_linearised(model: DynamicsModel, state: Tensor, action: Tensor) -> Tensor:
    """Return :meth:`DynamicsModel.jacobian` of a model with a closed :meth:`~.linearise`."""
    ahead, _, by_action = model.linearise(state, action)
    origin = state.unsqueeze(-2)
    return pushed_forward(lambda s: model.manifold.difference(s, origin), ahead, by_action)[1]
