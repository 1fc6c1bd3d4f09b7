"""The action that a model needs to explain a transition."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.compiling.tracing import all_hold
from afm_rl.dynamics.base import DynamicsModel
from afm_rl.spaces.small_matrices import add_diagonal, invert_positive

ROUNDS = 6  # steps of Gauss-Newton, at most
UNSEEN = 4.0  # standard deviation of an axis of which a transition shows nothing (half ranges)
ASSUMED = 0.1  # that where nothing needs an explanation (half ranges)
ENOUGH = 0.1  # what a round has to promise, to be worth its time (squared standard deviations)


class EffectiveAction(NamedTuple):
    """The effective action of a transition, under a model."""

    action: Tensor
    """Effective action, ``(*B, A)``, in the units of the action."""
    std: Tensor
    """Standard deviation of each component, in half ranges, ``(*B, A)``; at most four."""
    innovation: Tensor
    """Largest normalised error of the executed action's forecast, ``(*B)``."""
    derivative: Tensor | None = None
    """Of the forecast by the action where the search ended, ``(*B, D, A)``; None: not computed."""


class Search(NamedTuple):
    """Where the rounds stand that look for an effective action; h is the half range."""

    effective: Tensor
    """The best action up to now, ``(*B, A)``."""
    error: Tensor
    """What it leaves to be explained, in standard deviations, ``(*B, D)``."""
    left: Tensor
    """The squared length of that, ``(*B, 1)``."""
    jacobian: Tensor
    """J, of the normalised forecast by half ranges, ``(*B, D, A)``."""
    std: Tensor
    """Standard deviation of the action, in half ranges, ``(*B, A)``."""
    step: Tensor
    """The next step of Gauss-Newton, within the limit, in half ranges, ``(*B, A)``."""
    promised: Tensor
    """By how much a whole one would lessen ``left`` if all were linear, ``(*B, 1)``."""
    limit: Tensor
    """Half ranges that an axis may move in one step, ``(*B, 1)``."""
    renewed: Tensor
    """How often J was differentiated, ``(*B, 1)``."""
    going: Tensor
    """Is there more to be explained? ``(*B, 1)``."""

    @classmethod
    def begin(
        cls,
        action: Tensor,
        error: Tensor,
        jacobian: Tensor,
        renewed: Tensor,
        going: Tensor,
        limit: float = 1.0,
    ) -> Search:
        """Return the search before its first round, of rows that are ``going`` ``(*B, 1)``."""
        none = torch.zeros_like(jacobian[..., 0, :])
        return cls(
            effective=action,
            error=error,
            left=size_of(error),
            jacobian=jacobian,
            std=none + UNSEEN,
            step=none,
            promised=none[..., :1],
            limit=torch.full_like(renewed, limit),
            renewed=renewed,
            going=going,
        )

    def propose(self) -> Search:
        """Return it with the next step, and with how sure the action is."""
        jacobian = self.jacobian
        covariance = invert_positive(add_diagonal(jacobian.mT @ jacobian, UNSEEN**-2))
        std = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        slope = _times(jacobian.mT, self.error.double())
        step = _times(covariance, slope)
        return self._replace(
            std=torch.where(self.going, std, self.std),
            step=step.clamp(-self.limit, self.limit),
            promised=(step * slope).sum(-1, True),
        )

    def judge(self, trial: Tensor, remaining: Tensor) -> tuple[Search, Tensor]:
        """Return it after a step, and where J is to be differentiated again, ``(*B, 1)``.

        Args:
            trial: the action that was tried, ``(*B, A)``.
            remaining: the error that it leaves, ``(*B, D)``.
        """
        gained = self.left - size_of(remaining)
        better = self.going & (gained > 0)
        moved = torch.where(self.going, self.step, 0.0)
        going = self.going & (self.promised > ENOUGH)
        again = going & (gained < self.promised / 2) & (self.renewed < 1.0 + better)
        after = self._replace(
            effective=torch.where(better, trial, self.effective),
            error=torch.where(better, remaining, self.error),
            left=torch.where(better, self.left - gained, self.left),
            jacobian=_corrected(self.jacobian, moved, self.error - remaining),
            limit=torch.where(better | again, self.limit, 0.25 * self.limit),
            going=going,
        )
        return after, again

    def renew(self, again: Tensor, jacobian: Tensor) -> Search:
        """Return it with another J where it was differentiated again, ``(*B, 1)``."""
        renewed = self.renewed + again.to(self.renewed)
        jacobian = torch.where(again.unsqueeze(-1), jacobian, self.jacobian)
        return self._replace(jacobian=jacobian, renewed=renewed)

    def doubtful(self) -> Tensor:
        """Return the standard deviation ``(*B, A)`` with what the rounds could not explain."""
        per_coordinate = (self.left / self.error.shape[-1]).sqrt()
        return (self.std * per_coordinate.clamp_min(1.0)).clamp_max(UNSEEN)


def effective_action(
    model: DynamicsModel,
    state: Tensor,
    action: Tensor,
    next_state: Tensor,
    half_range: Tensor,
    rounds: int = ROUNDS,
    quiet: float | Tensor = 0.0,
    guess: Tensor | None = None,
    derivative: Tensor | None = None,
) -> EffectiveAction:
    r"""Return the effective action: the one that explains a transition under a model.

    .. math:: v = \operatorname{argmin}_v \; \| \Sigma^{-1/2} (s_{t+1} \ominus f(s_t, a + h v)) \|^2

    by Gauss-Newton: with J the derivative of the normalised forecast by v, and e the error,

    .. math:: v \leftarrow v + C J^\top e,\qquad C = (J^\top J + 4^{-2} I)^{-1}

    The weak prior gives an axis without influence a standard deviation of four half ranges,
    and does not change it. The noise :math:`\Sigma` is that of the executed action's forecast;
    ``std`` is the square root of C's diagonal, in half ranges.

    A model that is affine in its action takes one round. With others, the rounds of a row begin at
    the ``guess`` where that explains the transition better than the executed action: contacts have
    many local minima, and a correction that is right lies in the deepest. A round moves each axis
    by half a range at most, a row is only changed where its error becomes smaller (its next step
    is a quarter as long where it does not), and its rounds end early when little is left that an
    action can explain. Each step d, which changes the forecast by :math:`\Delta`, corrects J
    (Broyden 1965, Mathematics of Computation 19),

    .. math:: J \leftarrow J + \frac{(\Delta - J d)\, d^\top}{d^\top d}

    and after a step with less than half of the predicted gain J is differentiated again, twice
    at most, the first time included. With the ``derivative`` of the transition before, rows begin
    with that one.

    ``std`` grows by the root mean square of the normalised error that remains, where that exceeds
    1, because an unresolved contact gives little information.

    A row with a number that is not finite has no information: it gets the executed action, the
    largest ``std``, and innovation 0.

    Args:
        model: f, as it is now.
        state: ``(*B, S)``.
        action: the action that was executed, ``(*B, A)``.
        next_state: the realised next state, ``(*B, S)``.
        half_range: h, the unit of v: half ranges of the box, or largest actions, ``(A,)``.
        rounds: Gauss-Newton steps at most.
        quiet: innovations up to this size need no explanation: the executed action is returned,
            with a standard deviation of a tenth; one number, or one per row ``(*B)``.
        guess: where else to begin, such as the effect that was predicted, ``(*B, A)``.
        derivative: that of the transition before, ``(*B, D, A)``, in rows that are not zero; None:
            it is computed.

    >>> from afm_rl.dynamics import Dubins
    >>> s, a = torch.zeros(3), torch.tensor([0.5, 0.2])
    >>> seen = Dubins()(s, -a)  # both motors reversed
    >>> found = effective_action(Dubins(), s, a, seen, torch.ones(2))
    >>> found.action, found.std
    (tensor([-0.5000, -0.2000]), tensor([0.0050, 0.0050]))
    """
    # 1. Compare: how far is the transition from what the executed action should have led to?
    transition = Transition.of(model, state, action, next_state, half_range)
    innovation = transition.error.abs().amax(-1)
    silent = innovation <= quiet  # false for NaN
    if all_hold(silent):  # nothing more to compute
        std = torch.full_like(action, ASSUMED)
        return EffectiveAction(action, std, innovation.to(action), derivative)
    # 2. Search: Gauss-Newton from the executed action, or from the guess.
    going = ~silent.unsqueeze(-1)
    search = transition.search(model, guess, derivative, going, rounds)
    # 3. Report: the action that was found, and how sure it is.
    ended = (search.jacobian / transition.per_unit).nan_to_num(0.0, 0.0, 0.0)
    std = search.std if model.affine else search.doubtful()
    finite = innovation + std.sum(-1) < torch.inf
    found, otherwise = finite.unsqueeze(-1) & going, torch.where(going, UNSEEN, ASSUMED)
    return EffectiveAction(
        torch.where(found, search.effective, action.nan_to_num()).to(action.dtype),
        torch.where(found, std, otherwise).to(action.dtype),
        torch.where(finite, innovation, 0.0).to(action.dtype),
        ended if derivative is None else torch.where(going.unsqueeze(-1), ended, derivative),
    )


class Transition(NamedTuple):
    """A transition as a model sees it; in double precision, if the model is stiff."""

    state: Tensor
    """``(*B, S)``."""
    action: Tensor
    """The executed action, ``(*B, A)``."""
    next_state: Tensor
    """``(*B, S)``."""
    half_range: Tensor
    """h, ``(A,)``."""
    noise: Tensor
    """Standard deviations of the forecast, ``(*B, D)``."""
    error: Tensor
    """What the executed action leaves to be explained, in these, ``(*B, D)``."""

    @classmethod
    def of(
        cls,
        model: DynamicsModel,
        state: Tensor,
        action: Tensor,
        next_state: Tensor,
        half_range: Tensor,
    ) -> Transition:
        """Compare a transition with the forecast of a model."""
        if model.stiff:
            state, action, next_state = state.double(), action.double(), next_state.double()
        expected, noise = model.forecast(state, action)
        error = model.manifold.difference(next_state, expected) / noise
        return cls(state, action, next_state, half_range.to(action), noise, error)

    @property
    def per_unit(self) -> Tensor:
        """Factor from derivatives to normalised ones by half ranges, ``(*B, D, A)``."""
        return self.half_range / self.noise.unsqueeze(-1)

    def error_of(self, model: DynamicsModel, action: Tensor) -> Tensor:
        """Return what another action ``(*B, A)`` would leave to be explained, ``(*B, D)``."""
        return model.manifold.difference(self.next_state, model(self.state, action)) / self.noise

    def derivative_at(self, model: DynamicsModel, action: Tensor, rows: Tensor) -> Tensor:
        """Return the normalised derivative by half ranges, ``(*B, D, A)``, of rows ``(*B, 1)``."""
        return (model.jacobian(self.state, only(rows, action, model)) * self.per_unit).double()

    def search(
        self,
        model: DynamicsModel,
        guess: Tensor | None,
        derivative: Tensor | None,
        going: Tensor,
        rounds: int,
    ) -> Search:
        """Return the search after its rounds; arguments are those of :func:`effective_action`."""
        effective, error, renewed = self.action, self.error, torch.ones_like(self.error[..., :1])
        jacobian = None if derivative is None else derivative * self.per_unit.double()
        if guess is not None and not model.affine:
            guess = only(going, guess.to(effective), model)
            there = self.error_of(model, guess)
            if jacobian is not None:
                moved = (guess - effective) / self.half_range
                jacobian = _corrected(jacobian, moved, error - there)
            better = size_of(there) < size_of(error)
            effective = torch.where(better, guess, effective)
            error = torch.where(better, there, error)
        if derivative is None or jacobian is None:
            jacobian = self.derivative_at(model, effective, going)
        else:
            size = derivative.abs().sum((-2, -1)).unsqueeze(-1)
            known = (size > 0) & (size < torch.inf)
            renewed = (~known).to(error)
            if not all_hold(known | ~going):
                computed = self.derivative_at(model, effective, going & ~known)
                jacobian = torch.where(known.unsqueeze(-1), jacobian, computed)
        limit = torch.inf if model.affine else 1.0  # where all is linear, a whole step is right
        search = Search.begin(effective, error, jacobian, renewed, going, limit)
        for last in (False,) * (rounds - 1) + (True,):
            search = search.propose()
            trial = search.effective + (search.step * self.half_range).to(effective)
            if model.affine:
                return search._replace(effective=trial)
            search, again = search.judge(trial, self.error_of(model, trial))
            if last or all_hold(~search.going):
                break
            if not all_hold(~again):
                search = search.renew(again, self.derivative_at(model, search.effective, again))
        return search


def only(rows: Tensor, action: Tensor, model: DynamicsModel) -> Tensor:
    """Return actions ``(*B, A)``, NaN except in some rows ``(*B, 1)`` if this saves time."""
    return torch.where(rows, action, torch.nan) if model.skips_nan else action


def size_of(rows: Tensor) -> Tensor:
    """Return the squared length of rows ``(*B, N)``, ``(*B, 1)``."""
    return (rows * rows).sum(-1, True)


def _corrected(jacobian: Tensor, step: Tensor, change: Tensor) -> Tensor:
    """Return derivatives ``(*B, D, A)`` by which a step ``(*B, A)`` has its change ``(*B, D)``."""
    along = step / size_of(step).clamp_min(1e-24)
    return jacobian + (change - _times(jacobian, step)).unsqueeze(-1) * along.unsqueeze(-2)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return matrices ``(*B, N, M)`` times vectors ``(*B, M)``, in fewer operations than ``@``."""
    return (matrix * vector.unsqueeze(-2)).sum(-1)
