"""System identification: the physics of a body that explain the error that no action explains."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, cast

import torch
from annotated_types import Ge, Le
from tensordict import TensorDictBase
from torch import Tensor

from afm_rl.dynamics import PhysicsModel
from afm_rl.errors import ConfigurationError, check_number
from afm_rl.learning.error_decomposition import check_half_range, decompose_error
from afm_rl.learning.loss import GaussianNLLLoss
from afm_rl.learning.updater import Learner
from afm_rl.options import Count, NonNegative, Positive, options


class PhysicsIdentifier(Learner):
    r"""Finds mass, lengths, ... of a body, among candidates, per mission, at every step.

    No action can compensate another length of a body, but an action can compensate a reversed
    motor. So each candidate :math:`\theta` is compared by the error that *no action explains* under
    it (:func:`~afm_rl.learning.error_decomposition.decompose_error`), independent of the actuators:

    .. math:: r_\theta = (I - J_\theta J_\theta^+)\,N^{-1}\,
        (s_{t+1} \ominus f_\theta(s_t, v_\theta)),\qquad
        c_\theta \leftarrow \lambda c_\theta + \log(1 + \|r_\theta\|^2)

    with :math:`v_\theta` the action that explains the transition best. The logarithm limits the
    influence of outliers. The candidate with the least :math:`c_\theta` becomes the model's physics
    once it is better by ``margin``. Transitions that the current physics explain within the gate
    are not used, so a nominal body stays nominal, bit for bit.

    Together with an action flow transform it learns what the transform cannot compensate. A mass
    that acts only on the actuated axes looks like weak actuators, and is left to the transform.

    Args:
        loss: a loss over a model whose physics can be set, such as
            :class:`~afm_rl.dynamics.MuJoCoDynamics` or
            :class:`~afm_rl.dynamics.ParametricDynamics`; its keys are read.
        ranges: lowest and highest value of each parameter that may differ, by its name in
            ``model.physics_names``.
        scale: half range of each action, ``(A,)``.

    Raises:
        ConfigurationError: for a setting out of range, or a model without physics.

    >>> from tensordict import TensorDict
    >>> pole = '''<mujoco><worldbody><body><joint type="slide" axis="1 0 0" name="x"/>
    ... <geom size=".1"/><body><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 1"
    ... size=".05"/></body></body></worldbody><actuator><motor joint="x"/></actuator></mujoco>'''
    >>> from afm_rl.dynamics import MuJoCoDynamics
    >>> model = MuJoCoDynamics(pole, frame_skip=10, noise_std=1e-3)
    >>> updater = PhysicsIdentifier(GaussianNLLLoss(model), {"length": [0.5, 1.5]}, [1.0], 11)
    >>> state, long = torch.tensor([0.0, 0.3, 0.0, 0.0]), model.nominal.clone()
    >>> long[model.physics_names.index("length")] = 1.3
    >>> for _ in range(5):  # and its motor runs backwards
    ...     with model.assuming(long):
    ...         after = model(state, torch.tensor([-1.0]))
    ...     td = TensorDict({"observation": state, "action": torch.ones(1)})
    ...     _ = updater(td.set(("next", "observation"), after))
    ...     state = after
    >>> updater.physics["length"]
    tensor(1.3000)
    """

    candidates: Tensor
    scale: Tensor

    @options("updater")
    def __init__(
        self,
        loss: GaussianNLLLoss,
        ranges: Mapping[str, Sequence[float]],
        scale: Sequence[float] | Tensor,
        count: Annotated[int, Ge(2), "candidates per parameter, all combinations of them"] = 97,
        gate: Annotated[
            NonNegative, "unmatched error above which it acts, standard deviations"
        ] = 3.0,
        forgetting: Annotated[
            Positive, Le(1), "weight of a transition relative to the next"
        ] = 0.95,
        margin: Annotated[NonNegative, "nats by which a new candidate must be better"] = 3.0,
        lost: Annotated[NonNegative, "nats by which a failed simulation is worse"] = 20.0,
        most: Annotated[Count, "largest number of candidates; all are simulated"] = 1000,
    ) -> None:
        super().__init__(loss)
        model = loss.model
        if not isinstance(model, PhysicsModel):
            raise ConfigurationError(
                "updater: PhysicsIdentifier needs a model with physics, got "
                f"{type(model).__name__}; choose dynamics=physics with a robot in MuJoCo, or "
                "updater=rls"
            )
        self.register_buffer(
            "candidates", _candidates(model, ranges, count, most), persistent=False
        )
        self.register_buffer(
            "scale", check_half_range(scale, loss.model.action_size), persistent=False
        )
        self.gate, self.forgetting, self.margin, self.lost = gate, forgetting, margin, lost

    @property
    def model(self) -> PhysicsModel:
        """The model whose physics are set."""
        return cast(PhysicsModel, self.loss.model)

    @property
    def physics(self) -> dict[str, Tensor]:
        """The current estimate, by the name of each parameter; ``(*L)``."""
        chosen = self.memory.get("chosen", torch.zeros(self.model.lead, dtype=torch.long))
        values = self.candidates[chosen].reshape(*self.model.lead, -1)
        return dict(zip(self.model.physics_names, values.unbind(-1), strict=True))

    def start(self, tensordict: TensorDictBase | None = None) -> None:
        """Begin with the nominal physics."""
        super().start(tensordict)
        misfit = self.candidates.new_zeros(math.prod(self.model.lead), len(self.candidates))
        self._believe(misfit, misfit[:, 0].long())

    def _believe(self, misfit: Tensor, chosen: Tensor) -> None:
        """Store misfits of candidates (nats) ``(l, K)``, and the best candidates ``(l)``."""
        self.memory.update({"misfit": misfit, "chosen": chosen})
        self.model.set_physics(self.candidates[chosen].reshape(*self.model.lead, -1))

    def _learn(self, terms: dict[str, Tensor], transitions: TensorDictBase, learn: Tensor) -> None:
        """Compare the candidates on transitions that the current physics do not explain."""
        misfit, chosen = self.memory["misfit"], self.memory["chosen"]
        rows = learn.flatten().nonzero().squeeze(-1)
        mission = rows // (learn.numel() // len(chosen))
        given = (transitions.get(key) for key in self.loss.in_keys)
        flat = [part.reshape(-1, part.shape[-1])[rows] for part in given]
        unexplained = self._unmatched(flat, self.candidates[chosen[mission]])
        odd = (unexplained.abs() > self.gate).any(-1)  # false for NaN
        if not bool(odd.any()):
            return
        mission, count = mission[odd], len(self.candidates)
        states, actions, afters = (part[odd].unsqueeze(1).expand(-1, count, -1) for part in flat)
        rest = self._unmatched(
            [states, actions, afters], self.candidates.expand(len(states), -1, -1)
        )
        new = rest.square().sum(-1).log1p().nan_to_num(nan=self.lost, posinf=self.lost).to(misfit)
        decayed = misfit.clone()
        decayed[mission] = self.forgetting * misfit[mission]
        misfit = decayed.index_add(0, mission, new)
        best = misfit.argmin(-1)
        least, now = (misfit.gather(1, k.unsqueeze(1)).squeeze(1) for k in (best, chosen))
        self._believe(misfit, torch.where(least + self.margin < now, best, chosen))

    def _unmatched(self, transitions: Sequence[Tensor], physics: Tensor) -> Tensor:
        state, action, after = transitions
        with self.model.assuming(physics):
            return decompose_error(self.model, state, action, after, self.scale).unmatched


def _candidates(
    model: PhysicsModel, ranges: Mapping[str, Sequence[float]], count: int, most: int
) -> Tensor:
    """Return rows of physics ``(K, P)``; the first is the nominal one."""
    names = model.physics_names
    if not isinstance(ranges, Mapping) or not ranges or not set(ranges) <= set(names):
        raise ConfigurationError(
            f"updater.ranges={ranges!r}: expected what may differ about the body, such as "
            f"{{mass: [0.5, 2.0]}}; names are {', '.join(names)}"
        )
    total = count ** len(ranges)
    if total > most:
        raise ConfigurationError(
            f"updater.count={count}: {total} combinations of {len(ranges)} parameters, expected at "
            f"most {most}; choose a lower count or fewer ranges"
        )
    axes = []
    for name, span in ranges.items():
        if len(span) != 2:
            raise ConfigurationError(f"updater.ranges.{name}={span}: expected [low, high]")
        low = check_number(f"updater.ranges.{name}: low", span[0])
        high = check_number(f"updater.ranges.{name}: high", span[1], low=low, open_low=True)
        axes.append(torch.linspace(low, high, count))
    rows = model.nominal.repeat(total + 1, 1)
    columns = [names.index(name) for name in ranges]
    rows[1:, columns] = torch.cartesian_prod(*axes).reshape(total, -1).to(rows)
    return rows
