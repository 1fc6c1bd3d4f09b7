"""Any dynamics model, plus what it misses of one healthy robot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from afm_rl.compiling.tracing import may_look
from afm_rl.dynamics.base import DynamicsModel, PerMissionModel, closed_form
from afm_rl.dynamics.rates import pushed_forward
from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.storage.artefacts import read_tensors, save_tensors

FAR = 4.0  # standard deviations of the fitted steps, beyond which nothing is extrapolated
PARTS = ("mean", "std", "weights", "noise", "explained", "steps")
"""What is fitted, and what is known of the fit."""


def nominal_of(model: Any) -> Any:
    """Return the nominal model of one with a residual; anything else as it is."""
    return model.model if isinstance(model, LinearResidual) else model


class LinearResidual(PerMissionModel):
    r"""A nominal model plus a correction, linear in state and predicted motion.

    .. math:: f(s, a) = \hat f(s, a) \oplus W^\top [1,\ z(s),\ z(m)],\qquad
              m = \hat f(s, a) \ominus s

    z subtracts the mean of the fitted steps, divides by their standard deviation, and is limited to
    four in size. A wrong mass, gear or wheel radius is a factor on m; gravity, damping and
    stiffness depend on s. The noise is the larger one of the model's and the measured noise.

    Before :func:`~afm_rl.fit_residual` or ``residual_steps`` has fitted it, it equals the
    nominal model, bit for bit.

    Args:
        model: the nominal model, which does not change.

    Attributes:
        weights: W, ``(*L, 1 + S + D, D)``; rows of inputs that do not matter are 0.
        mean, std: of the inputs, ``(*L, S + D)``.
        noise: standard deviation of the remaining error, ``(*L, D)``, by cross-validation.
        explained: share of the squared error that the residual explains, ``(*L, D)``, likewise.
        steps: number of steps of the fit, ``(*L)``; 0: not fitted.

    Raises:
        ConfigurationError: for a model that has such a residual already.

    >>> from afm_rl.dynamics import Dubins
    >>> model = LinearResidual(Dubins())
    >>> model.noise += 0.5
    >>> model.noise_scale(torch.zeros(3), torch.zeros(2))
    tensor([0.5000, 0.5000, 0.5000])
    """

    mean: Tensor
    std: Tensor
    weights: Tensor
    noise: Tensor
    explained: Tensor
    steps: Tensor

    def __init__(self, model: DynamicsModel) -> None:
        super().__init__(model.manifold, model.action_size)
        if isinstance(model, LinearResidual):
            raise ConfigurationError(
                "dynamics: the model has a residual already; give its nominal model, model.model"
            )
        self.model = model
        for name in ("affine", "stiff", "extrapolates", "keeps_derivative", "skips_nan"):
            setattr(self, name, getattr(model, name))
        for name in ("names", "dt", "action_low", "action_high"):
            if hasattr(model, name):
                setattr(self, name, getattr(model, name))
        motion = self.manifold.tangent_size
        inputs = self.state_size + motion
        shapes = {"mean": (inputs,), "std": (inputs,), "weights": (1 + inputs, motion)}
        for name in PARTS[:-1]:
            part = torch.zeros(shapes.get(name, (motion,)), dtype=torch.float64)
            self.register_buffer(name, part + (name == "std"))
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))

    @property
    def home(self) -> Tensor | None:  # type: ignore[override]
        """Neutral action of the nominal model."""
        return self.model.home

    @property
    def lead(self) -> torch.Size:
        return self.steps.shape

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        return self.adjusted(state, self.model(state, action))

    def adjusted(self, state: Tensor, after: Tensor) -> Tensor:
        """Add the residual to predictions ``(*L, *N, S)`` of the nominal model."""
        if self._unfitted:
            return after
        state = state.expand(*after.shape[:-1], -1)
        inputs = torch.cat([state, self.manifold.difference(after, state)], -1)
        z = (inputs - self._wide("mean", after)) / self._wide("std", after)
        weights = self._wide("weights", after)
        missed = z.clamp(-FAR, FAR).unsqueeze(-2) @ weights[..., 1:, :]
        moved = self.manifold.add(after, missed.squeeze(-2) + weights[..., 0, :])
        fitted = self._wide("steps", after).unsqueeze(-1) > 0
        return torch.where(fitted, moved, after)

    @closed_form
    def forecast(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        after, noise = self.model.forecast(state, action)
        return self.adjusted(state, after), noise.maximum(self._wide("noise", noise))

    def noise_scale(self, state: Tensor, action: Tensor) -> Tensor:
        stated = self.model.noise_scale(state, action)
        return stated.maximum(self._wide("noise", stated))

    def standardise(self, change: Tensor) -> Tensor:
        return self.model.standardise(change)

    @closed_form
    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        """Return the states of plans; before the fit by the nominal model."""
        if self._unfitted:
            return self.model.rollout(state, actions)
        return super().rollout(state, actions)

    @closed_form
    def jacobian(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the nominal model's Jacobian, by the chain rule through its motion.

        Quaternions of states are of unit length.
        """
        nominal = self.model.jacobian(state, action)
        if self._unfitted:
            return nominal
        space, after = self.manifold, self.model(state, action)
        origin = state.expand(*after.shape[:-1], -1)
        here = origin.unsqueeze(-2)

        def change(motion: Tensor) -> Tensor:
            return space.difference(self.adjusted(here, space.add(here, motion)), here)

        slope = pushed_forward(change, space.difference(after, origin), nominal)[1]
        return torch.where(self._wide("steps", after)[..., None, None] > 0, slope, nominal)

    @closed_form
    def linearise(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        after, by_state, by_action = self.model.linearise(state, action)
        if self._unfitted:
            return after, by_state, by_action
        sizes = (self.state_size, self.action_size)
        identity = torch.eye(sizes[0], sum(sizes)).to(after).expand(*after.shape[:-1], -1, -1)
        slope = torch.cat([identity, torch.cat([by_state, by_action], -1)], -2)
        both = torch.cat([state.expand(*after.shape[:-1], -1), after], -1)
        moved, slope = pushed_forward(lambda x: self.adjusted(*x.chunk(2, -1)), both, slope)
        return moved, *slope.split(sizes, -1)

    def fitted_(self, rows: Tensor | None = None, **parts: Tensor) -> LinearResidual:
        """Set the fitted parts, in place.

        Args:
            rows: mask of the robots, ``(*L)``; None: all.
            parts: some of :data:`PARTS`, ``(*L, ...)``.
        """
        for name, value in parts.items():
            now = self.get_buffer(name)
            value = value.to(now).expand(now.shape)
            if rows is not None:
                mask = rows[(..., *[None] * (now.dim() - rows.dim()))]
                value = torch.where(mask.to(now.device), value, now)
            setattr(self, name, value.clone())
        return self

    def expand_to_(self, lead: torch.Size) -> LinearResidual:
        """Give each of a batch of robots ``(*L)`` its own residual, in place."""
        self._replace_owned(lambda part: part.expand((*lead, *part.shape)).clone())
        return self

    def of(self, row: int | tuple[int, ...]) -> LinearResidual:
        """Return the model of one robot of a batch."""
        one = LinearResidual(self.model)
        return one.fitted_(**{name: self.get_buffer(name)[row] for name in PARTS})

    def save(self, path: str | Path) -> None:
        """Write the residual, without the nominal model, as safetensors with a checksum."""
        save_tensors(Path(path), {name: self.get_buffer(name) for name in PARTS}, self._about)

    @classmethod
    def load(cls, path: str | Path, model: DynamicsModel) -> LinearResidual:
        """Return a nominal model with the residual that :meth:`save` wrote.

        Raises:
            ConfigurationError: if there is no such file.
            ArtefactError: if it is damaged, or was fitted to a robot of other sizes.
        """
        found = cls(model)
        tensors, about = read_tensors(Path(path))
        if about != found._about:
            raise ArtefactError(
                f"{path}: was written for {about}, expected {found._about}: give the nominal "
                "model that it was fitted with, or fit it again"
            )
        lead = tensors["steps"].shape if "steps" in tensors else ()
        wanted = {name: (*lead, *found.get_buffer(name).shape) for name in PARTS}
        shapes = {name: tuple(value.shape) for name, value in tensors.items()}
        if shapes != wanted or not all(bool(x.isfinite().all()) for x in tensors.values()):
            raise ArtefactError(
                f"{path}: tensors {shapes}: expected finite ones {wanted}; fit the residual again"
            )
        return found.expand_to_(torch.Size(lead)).fitted_(**tensors)

    @property
    def _about(self) -> dict[str, object]:
        sizes = {"states": self.state_size, "actions": self.action_size}
        return {"kind": "linear residual", **sizes}

    @property
    def _unfitted(self) -> bool:
        """Is nothing fitted yet? True if the values cannot be read."""
        return may_look(self.steps) and not bool(self.steps.any())

    def _owned(self) -> list[tuple[nn.Module, str]]:
        return [(self, name) for name in PARTS]

    def _wide(self, name: str, like: Tensor) -> Tensor:
        """Insert dimensions into a part ``(*L, ...)`` so that it goes with ``(*L, *N, D)``."""
        part, lead = self.get_buffer(name), self.lead
        self._check_lead(like.shape[:-1])
        between = (1,) * (like.dim() - 1 - len(lead))
        return part.reshape((*lead, *between, *part.shape[len(lead) :])).to(like)
