"""Any dynamics model, corrected by a few numbers per mission."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from afm_rl.compiling.tracing import may_look
from afm_rl.dynamics.base import DynamicsModel, PerMissionModel, closed_form
from afm_rl.dynamics.rates import linearised
from afm_rl.errors import ConfigurationError


class Calibrated(PerMissionModel):
    r"""A frozen model with an affine map of its action and an offset of its output.

    .. math:: f(s, a) = \mathrm{model}(s,\ a') \oplus c,\qquad
              a' = h \odot (D\,a / h + b)

    with h the half ranges of the action. D and b describe what other actions can undo (*matched*
    uncertainty), c what no action can (*unmatched*). For missions whose calibration is the
    identity, predictions equal those of the model bit for bit.

    The calibration is set with :meth:`calibrate_`, not trained by gradients. :meth:`expand_`
    gives every mission its own calibration; the model itself is shared and does not change.

    Args:
        model: the nominal dynamics; its missions share parameters.
        half_range: h, half ranges of the action bounds, ``(A,)``.

    Raises:
        ConfigurationError: for half ranges that do not fit, or a model with separate
            parameters for missions.

    >>> from afm_rl.dynamics import Dubins
    >>> model = Calibrated(Dubins(), torch.tensor([1.0, 1.5]))
    >>> model.calibrate_(matrix=torch.diag(torch.tensor([-1.0, 1.0])))  # it drives backwards
    >>> model(torch.zeros(3), torch.tensor([1.0, 0.0]))
    tensor([-0.2000,  0.0000,  0.0000])
    """

    conditioned_on = "calibration"
    half_range: Tensor
    matrix: Tensor
    bias: Tensor
    offset: Tensor

    def __init__(self, model: DynamicsModel, half_range: Tensor) -> None:
        super().__init__(model.manifold, model.action_size)
        if model.lead:
            raise ConfigurationError(
                f"dynamics: the model holds {tuple(model.lead)} missions; calibrate "
                "a model that all missions share"
            )
        half_range, size = torch.as_tensor(half_range), model.action_size
        if half_range.shape != (size,) or not bool((half_range > 0).all()):
            raise ConfigurationError(
                f"dynamics.half_range={half_range.tolist()}: expected {size} numbers > 0"
            )
        self.model = model
        self.extrapolates = model.extrapolates
        self.register_buffer("half_range", half_range, persistent=False)
        self.register_buffer("matrix", torch.eye(size))
        self.register_buffer("bias", torch.zeros(size))
        self.register_buffer("offset", torch.zeros(model.manifold.tangent_size))

    def calibrate_(self, **calibration: Tensor) -> None:
        """Set parts of the calibration, in place.

        Args:
            calibration: any of ``matrix`` ``(*L, A, A)``, ``bias`` ``(*L, A)`` and ``offset``
                ``(*L, D)``.
        """
        for name, value in calibration.items():
            now = self.get_buffer(name)
            setattr(self, name, value.detach().to(now).expand(now.shape).clone())

    def effective(self, action: Tensor) -> Tensor:
        """Return a', the input of the model, for actions ``(*L, *N, A)``."""
        unit = action / self.half_range
        matrix, moved = self._wide(self.matrix, action), self._wide(self.bias, action)
        for axis in range(self.action_size):  # faster than products of very small matrices
            moved = torch.addcmul(moved, matrix[..., axis], unit[..., axis, None])
        return action + self.half_range * (moved - unit)  # plus exactly 0 for the identity

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        return self._shifted(self.model(state, self.effective(action)))

    @closed_form
    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        """Return the states of plans; by the model itself if there is no offset."""
        states = self.model.rollout(state, self.effective(actions))
        if _any(self.offset):
            moved = self._wide((self.offset != 0).any(-1, keepdim=True), states)
            states = torch.where(moved.bool(), super().rollout(state, actions), states)
        return states

    @closed_form
    def forecast(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        ahead, noise = self.model.forecast(state, self.effective(action))
        return self._shifted(ahead), noise

    @closed_form
    def jacobian(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the model's Jacobian ``(*L, *N, D, A)`` times that of a'."""
        if not self._flat:
            return super().jacobian(state, action)
        return self.model.jacobian(state, self.effective(action)) @ self._slope(action)

    @closed_form
    def linearise(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        ahead, by_state, by_action = self.model.linearise(state, self.effective(action))
        by_action = by_action @ self._slope(action)
        if self._flat:
            return self._shifted(ahead), by_state, by_action
        nothing = action[..., :0]
        moved, through, _ = linearised(lambda there, _: self._shifted(there), ahead, nothing)
        return moved, through @ by_state, through @ by_action

    def moments(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the model's moments at a', shifted by c (to first order for rotations)."""
        mean, log_variance = self.model.moments(state, self.effective(action))
        offset = self._wide(self.offset, mean[..., 0, :])
        moved = self.standardise(offset) - self.standardise(torch.zeros_like(offset))
        return mean + moved.unsqueeze(-2), log_variance

    def standardise(self, change: Tensor) -> Tensor:
        return self.model.standardise(change)

    def noise_scale(self, state: Tensor, action: Tensor) -> Tensor:
        return self.model.noise_scale(state, self.effective(action))

    def _owned(self) -> list[tuple[nn.Module, str]]:
        return [(self, name) for name in ("matrix", "bias", "offset")]

    @property
    def _flat(self) -> bool:
        """Whether adding c leaves derivatives as they are."""
        return self.manifold.tangent_size == self.manifold.size

    def _shifted(self, ahead: Tensor) -> Tensor:
        """Add c; states of missions without any stay as they are, to the bit."""
        if _any(self.offset):
            offset = self._wide(self.offset, ahead)
            moved = self.manifold.add(ahead, offset)
            return torch.where((offset != 0).any(-1, keepdim=True), moved, ahead)
        return ahead

    def _slope(self, action: Tensor) -> Tensor:
        """Return the derivative of a' ``(*L, *N, A, A)``."""
        matrix = self._wide(self.matrix, action)
        return self.half_range.unsqueeze(-1) * matrix / self.half_range

    def _wide(self, part: Tensor, like: Tensor) -> Tensor:
        """Insert dimensions into ``(*L, ...)`` so that it goes with ``(*L, *N, ...)``."""
        lead = len(self.lead)
        self._check_lead(like.shape[:-1])
        extra = like.dim() - 1 - lead
        return part.reshape((*part.shape[:lead], *(1,) * extra, *part.shape[lead:])).to(like)


def _any(part: Tensor) -> bool:
    """Is any number not 0? True if the values cannot be read."""
    return not (may_look(part) and not bool(part.any()))
