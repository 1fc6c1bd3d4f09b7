"""Toys of the Actuator Inversion Benchmark, which need no simulator.

See :func:`~actuator_inversion.actuator_inversion_task`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from actuator_inversion.contexts import body_regime, contexts_of
from afm_rl.dynamics import KnownDynamics
from afm_rl.envs.task.task import NOWHERE, Task
from afm_rl.regimes import Regime
from afm_rl.spaces.manifold import Manifold

STEP, SMALL_STEP = 0.1, 0.01  # s, of the double integrators and of the ODE
MASS = (0.5, 1.5), (0.1, 2.0)  # ranges: training, and whole; also of the friction
COEFFICIENT = (-5.0, 5.0), (-10.0, 10.0)
NOMINAL = 2.5  # of both coefficients: the middle of one sign in training
NEAR, PAY = (0.05, 0.1, 0.2, 0.5, 2.0), (1.0, 1 / 2, 1 / 3, 1 / 4, 0.05, 0.0)  # of the ODE
SIGNS = 1.0, -1.0


def glide(state: Tensor, action: Tensor, friction: float = 0.0) -> Tensor:
    """Step of the double integrator: positions, then speeds; a unit mass, forces up to 1.

    >>> glide(torch.tensor([0.5, 0.0, 1.0, 0.0]), torch.tensor([0.0, 0.5]))
    tensor([0.6000, 0.0000, 1.0000, 0.0500])
    """
    place, speed = state.chunk(2, -1)
    faster = (1 - STEP * friction) * speed + STEP * action
    return torch.cat([place + STEP * speed, faster], -1).clamp(-1.0, 1.0)


def at_origin(state: Tensor, action: Tensor, after: Tensor) -> Tensor:
    """Reward of the double integrator: 1 within 0.1 of the origin."""
    return (after[..., :2].norm(dim=-1) <= 0.1).to(after)


def corner(seed: int) -> tuple[Tensor, Tensor]:
    """Return a start of the double integrator: both positions beyond 0.8, any speeds."""
    drawn = 2 * torch.rand(6, generator=torch.Generator().manual_seed(seed)) - 1
    places = drawn[:2].sign() * (0.8 + 0.2 * drawn[2:4].abs())
    return torch.cat([places, drawn[4:]]), NOWHERE


def integrator_regime(sign: float, mass: float = 1.0) -> dict[str, float]:
    """Return the regime of a mass, which divides the effect of a force."""
    gain = sign / mass
    return {} if gain == 1 else {"gain_0": gain, "gain_1": gain}


class Sled(Regime):
    r"""Mass m (kg) and friction k (kg/s) of the double integrator, with the nominal values 1.

    .. math:: a_\mathrm{eff} = a / m + (1 - k / m)\,v

    >>> slow = Sled().encode({"friction": 2.0})
    >>> Sled().apply(torch.ones(2), slow, torch.tensor([0.0, 0.0, 0.5, 0.0]))
    tensor([0.5000, 1.0000])
    """

    names = ("mass", "friction")
    identity = (1.0, 1.0)
    by_state = True
    span = MASS[0]

    def __init__(self) -> None:
        self.limits = {"mass": (0.01, 100.0), "friction": (0.0, 100.0)}

    def effect_of(self, action: Tensor, parameters: Tensor, state: Tensor) -> Tensor:
        mass, friction = parameters.split(1, -1)
        return action / mass + (1 - friction / mass) * state[..., 2:]

    def command_for(self, effect: Tensor, parameters: Tensor, state: Tensor) -> Tensor:
        mass, friction = parameters.split(1, -1)
        return effect * mass + (friction - mass) * state[..., 2:]


class Coefficients(Regime):
    r"""Coefficients c of the ODE, as the action with the same effect under the nominal C.

    .. math:: C_0\,b + C_1\,b^2 = c_0\,a + c_1\,a^2

    with complex actions :math:`a = a_0 + i\,a_1` and effective actions b; of the two solutions
    the one nearer to a. Parameters: ``c0`` and ``c1``.

    >>> both = Coefficients().encode({"c0": -5.0, "c1": -5.0})
    >>> action = torch.tensor([0.5, 0.0])
    >>> drift(torch.zeros(1), Coefficients().apply(action, both, torch.zeros(1)))
    tensor([-0.0375])
    """

    names = ("c0", "c1")
    identity = (NOMINAL, NOMINAL)
    span = COEFFICIENT[0]

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        number, (first, second) = torch.complex(*action.unbind(-1)), parameters.unbind(-1)
        wanted = (first * number + second * number**2) / NOMINAL
        root, ahead = (1 + 4 * wanted).sqrt(), 1 + 2 * number
        root = torch.where((root * ahead.conj()).real < 0, -root, root)
        effect = torch.view_as_real((root - 1) / 2)
        nominal = self.is_identity(parameters).unsqueeze(-1)  # to the bit
        return torch.where(nominal, action, effect)


def drift(state: Tensor, action: Tensor) -> Tensor:
    r"""Step of the ODE: :math:`\dot x = \mathrm{Re}(C_0\,a + C_1\,a^2)`, :math:`a = a_0 + i\,a_1`.

    >>> drift(torch.zeros(1), torch.tensor([0.5, 1.0]))
    tensor([-0.0062])
    """
    real, imaginary = action.split(1, -1)
    rate = NOMINAL * (real + real.square() - imaginary.square())
    return (state + SMALL_STEP * rate).clamp(-20.0, 20.0)


def close_by(state: Tensor, action: Tensor, after: Tensor) -> Tensor:
    """Reward of the ODE, which falls with the distance from the origin.

    >>> place = torch.tensor([[0.0], [-0.07], [3.0]])
    >>> close_by(place, place, place)
    tensor([1.0000, 0.5000, 0.0000])
    """
    place = after[..., 0].abs().contiguous()
    return after.new_tensor(PAY)[torch.bucketize(place, after.new_tensor(NEAR), right=True)]


def nearness(state: Tensor, action: Tensor, after: Tensor) -> Tensor:
    """Reward of the planner of the ODE: minus the distance from the origin."""
    return -after[..., 0].abs()


def integrator(contexts: int) -> Task:
    """Return the double integrator: another mass, without friction, and reversed forces."""
    return Task(
        name="double_integrator",
        world=KnownDynamics(glide, Manifold(4), 2, affine=True),
        start=corner,
        reward=at_origin,
        low=[-1.0, -1.0],
        high=[1.0, 1.0],
        dt=STEP,
        steps=100,
        state_names=["x", "y", "v_x", "v_y"],
        action_names=["f_x", "f_y"],
        contexts=contexts_of({"mass": MASS}, integrator_regime, SIGNS, contexts),
    )


def sled(contexts: int) -> Task:
    """Return the double integrator with friction: another mass and friction, one sign."""
    regime = Sled()
    spans = dict.fromkeys(regime.names, MASS)
    named = partial(body_regime, 2, **dict.fromkeys(regime.names, 1.0))
    world = KnownDynamics(partial(glide, friction=1.0), Manifold(4), 2, affine=True)
    return replace(
        integrator(contexts),
        name="double_integrator_friction",
        world=world,
        changes={"sled": regime},
        contexts=contexts_of(spans, named, SIGNS[:1], contexts),
    )


def ode(contexts: int) -> Task:
    """Return the ODE, in which actions enter with their squares."""
    regime = Coefficients()
    spans = dict.fromkeys(regime.names, COEFFICIENT)
    named = partial(body_regime, 2, **dict.fromkeys(regime.names, 1.0))

    def start(seed: int) -> tuple[Tensor, Tensor]:
        return 2 * torch.rand(1, generator=torch.Generator().manual_seed(seed)) - 1, NOWHERE

    return Task(
        name="ode",
        world=KnownDynamics(drift, Manifold(1), 2, noise_std=5e-4),
        start=start,
        reward=close_by,
        plan=nearness,
        low=[-1.0, -1.0],
        high=[1.0, 1.0],
        dt=SMALL_STEP,
        steps=200,
        state_names=["x"],
        action_names=["a_0", "a_1"],
        changes={"coefficients": regime},
        contexts=contexts_of(spans, named, SIGNS[:1], contexts),
    )


TOYS: dict[str, Callable[[int], Task]] = {
    "double_integrator": integrator,
    "double_integrator_friction": sled,
    "ode": ode,
}
"""What makes each toy, from the number of contexts of a split."""
