"""Rewards of published tasks as functions of whole states, in torch.

States are (qpos, qvel); a reward is that of the task itself, and where this says nothing far from
the goal, ``plan`` is what a planner is given instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from afm_rl.spaces.manifold import wrap_angle


def pendulum_step(state: Tensor, action: Tensor) -> Tensor:
    """Step of gymnasium's Pendulum-v1; the state is angle (rad, 0 is up) and speed (rad/s).

    >>> pendulum_step(torch.zeros(2), torch.tensor([2.0]))
    tensor([0.0150, 0.3000])
    """
    angle, speed = state.unbind(-1)
    speed = (speed + 0.05 * (15 * angle.sin() + 3 * action[..., 0])).clamp(-8.0, 8.0)
    return torch.stack([angle + 0.05 * speed, speed], -1)


def pendulum_observation(state: Tensor) -> Tensor:
    """Return what gymnasium's Pendulum-v1 shows: cosine and sine of the angle, and the speed.

    >>> pendulum_observation(torch.tensor([0.0, 3.0]))
    tensor([1., 0., 3.])
    """
    angle, speed = state.unbind(-1)
    return torch.stack([angle.cos(), angle.sin(), speed], -1)


Reward = Callable[..., Tensor]
LINK = 0.12  # m, each of the reacher's links


class Rewards(NamedTuple):
    """What is known of a task beside its physics."""

    reward: Reward
    plan: Reward | None = None
    ends: Callable[[Tensor], Tensor] | None = None
    ignored: Sequence[int] = ()
    """State coordinates that the dynamics do not depend on."""


def gaussian(distance: Tensor, margin: float) -> Tensor:
    """Return 1 at distance 0 and 0.1 at ``margin``, as dm_control's ``tolerance``.

    >>> gaussian(torch.tensor([0.0, 2.0]), 2.0)
    tensor([1.0000, 0.1000])
    """
    return torch.exp(math.log(0.1) * (distance / margin).square())


def cartpole(state: Tensor, action: Tensor, after: Tensor) -> Tensor:
    """Reward of dm_control's cart-poles with smooth rewards (balance, swingup)."""
    upright = (after[..., 1].cos() + 1) / 2
    centred = (1 + gaussian(after[..., 0], 2.0)) / 2
    effort = (4 + (1 - action[..., 0].square()).clamp_min(0.0)) / 5
    slow = (1 + gaussian(after[..., 3], 5.0)) / 2
    return upright * effort * slow * centred


def finger(state: Tensor, lengths: Sequence[float]) -> Tensor:
    """Return the tip ``(*B, 2)`` of an arm with two links of these lengths (m)."""
    first, second = state[..., 0], state[..., 0] + state[..., 1]
    upper, lower = lengths
    x = upper * first.cos() + lower * second.cos()
    return torch.stack([x, upper * first.sin() + lower * second.sin()], -1)


def touch(
    state: Tensor,
    action: Tensor,
    after: Tensor,
    goal: Tensor,
    radius: float,
    link: float = LINK,
) -> Tensor:
    """Reward of dm_control's reacher tasks: 1 where the finger touches the target.

    The goal is the target's place (m) as an arm whose links are :data:`LINK` long would see it: in
    units of its own ``link`` (m). There it stays if the links change under way.
    """
    gap = link / LINK * (finger(after, (LINK, LINK)) - goal).norm(dim=-1)
    return (gap <= radius).to(after)


def link_of(model: Any) -> float:
    """Return how long the links of dm_control's reacher are (m)."""
    return float(model.body("finger").pos[0])


def seen_target(model: Any, target: Tensor) -> Tensor:
    """Return the place of the reacher's target, see :func:`touch`."""
    return LINK / link_of(model) * target


def near(state: Tensor, action: Tensor, after: Tensor, goal: Tensor, radius: float) -> Tensor:
    """Return the reward of a touch, less the distance (m)."""
    gap = (finger(after, (LINK, LINK)) - goal).norm(dim=-1)
    return (gap <= radius).to(after) - gap


def cup_gap(after: Tensor) -> Tensor:
    """Return how far dm_control's ball is from the middle of the cup, ``(*B, 2)`` (m)."""
    return after[..., 2:4] - after[..., :2] - after.new_tensor([0.0, 0.35])


def catch(state: Tensor, action: Tensor, after: Tensor) -> Tensor:
    """Reward of dm_control's ball in a cup: 1 where the ball is in the cup."""
    return (cup_gap(after).abs() < 0.025).all(-1).to(after)


def above(state: Tensor, action: Tensor, after: Tensor) -> Tensor:
    """Return the reward of a catch, less the ball's distance (m) from the cup, or from above it.

    >>> below = torch.tensor([0.0, 0.0, 0.0, 0.1])  # it hangs under the cup
    >>> above(below, below[:2], below)
    tensor(-0.3750)
    """
    x, z = cup_gap(after).unbind(-1)
    outside = (x.abs() - 0.025).clamp_min(0.0)
    low = (0.1 - z).clamp_min(0.0) * ((outside > 0) | (z < -0.025))  # first over the rim
    return catch(state, action, after) - outside - low - 0.1 * z.abs()


def run(state: Tensor, action: Tensor, after: Tensor, arms: Tensor, turns: Tensor) -> Tensor:
    r"""Reward of dm_control's cheetah: its speed, up to 10 m/s.

    The centre of mass is at :math:`q_x + \sum_k R(\theta_k)\,d_k` with the absolute angles
    :math:`\theta = T q` of the bodies.

    Args:
        state: not used.
        action: not used.
        after: (qpos, qvel), ``(*B, 2 N)``.
        arms: offsets d (m), x and z, weighted with shares of the mass, ``(K, 2)``.
        turns: T, ``(K, N)``.
    """
    angles, speeds = (part @ turns.to(after).mT for part in after.chunk(2, -1))
    x, z = arms.to(after).unbind(-1)
    swing = (speeds * (z * angles.cos() - x * angles.sin())).sum(-1)
    speed = after[..., after.shape[-1] // 2] + swing
    return (speed / 10).clamp(0.0, 1.0)


def planar_body(model: Any) -> dict[str, Tensor]:
    """Return ``arms`` and ``turns`` of :func:`run` for a planar MuJoCo model that turns about y."""
    share = torch.from_numpy(model.body_mass / model.body_mass.sum())
    places, centres = (
        torch.from_numpy(part)[:, [0, 2]] for part in (model.body_pos, model.body_ipos)
    )
    arms, turns = share.unsqueeze(-1) * centres, torch.zeros(model.nbody, model.nv).double()
    for joint, body in enumerate(model.jnt_bodyid):
        if model.jnt_type[joint] == 3:  # a hinge
            below = [k for k in range(body, model.nbody) if _is_above(model, body, k)]
            turns[below, model.jnt_dofadr[joint]] = 1.0
    for body in range(1, model.nbody):
        below = [k for k in range(body, model.nbody) if _is_above(model, body, k)]
        arms[model.body_parentid[body]] += share[below].sum() * places[body]
    return {"arms": arms[1:], "turns": turns[1:]}


def _is_above(model: Any, body: int, other: int) -> bool:
    """Tell whether ``other`` is ``body``, or carried by it."""
    while other > body:
        other = model.body_parentid[other]
    return other == body


def sprint(state: Tensor, action: Tensor, after: Tensor, **body: Tensor) -> Tensor:
    """Return the reward of a run, less what the body pitches beyond 0.5 rad.

    A cheetah on its back runs as well for a while, and does not get up again.
    """
    upset = (wrap_angle(after[..., 2]).abs() - 0.5).clamp_min(0.0)
    return run(state, action, after, **body) - upset


def swing_up(state: Tensor, action: Tensor, after: Tensor) -> Tensor:
    """Reward of gymnasium's Pendulum-v1; the state is (angle, speed)."""
    angle, speed = state.unbind(-1)
    effort = action.clamp(-2, 2).square().sum(-1)
    return -(wrap_angle(angle).square() + 0.1 * speed.square() + 0.001 * effort)


def fallen(after: Tensor) -> Tensor:
    """Tell where the pole of gymnasium's InvertedPendulum-v5 has fallen."""
    return ~(after[..., 1].abs() <= 0.2)


def stand(state: Tensor, action: Tensor, after: Tensor) -> Tensor:
    """Reward of gymnasium's InvertedPendulum-v5: 1 until the pole falls."""
    return (~fallen(after)).to(after)


def upright(state: Tensor, action: Tensor, after: Tensor) -> Tensor:
    """Return how well the pole stands in the middle, at most 0; a fall costs 1 a step."""
    return -(after[..., 1].square() + 0.05 * after[..., 0].square()) - fallen(after).to(after)


def reach(state: Tensor, action: Tensor, after: Tensor) -> Tensor:
    """Reward of gymnasium's Reacher-v5; the target is part of the state."""
    gap = (finger(after, (0.1, 0.11)) - after[..., 2:4]).norm(dim=-1)
    return -gap - action.square().sum(-1)


def forward(state: Tensor, action: Tensor, after: Tensor, dt: float = 0.05) -> Tensor:
    """Reward of gymnasium's HalfCheetah-v5."""
    return (after[..., 0] - state[..., 0]) / dt - 0.1 * action.square().sum(-1)


def forward_upright(state: Tensor, action: Tensor, after: Tensor) -> Tensor:
    """Return the same less what the body pitches beyond 0.5 rad: somersaults lead nowhere."""
    upset = (after[..., 2].abs() - 0.5).clamp_min(0.0)
    return forward(state, action, after) - upset


def _touches(model: Any, radius: float) -> Rewards:
    reward = partial(touch, radius=radius, link=link_of(model))
    return Rewards(reward, partial(near, radius=radius))


def _runs(model: Any) -> Rewards:
    body = planar_body(model)
    return Rewards(partial(run, **body), partial(sprint, **body), ignored=[0])


DM_CONTROL: dict[str, dict[str, Rewards | Callable[[Any], Rewards]]] = {
    "cartpole": {"balance": Rewards(cartpole), "swingup": Rewards(cartpole)},
    "reacher": {"easy": partial(_touches, radius=0.06), "hard": partial(_touches, radius=0.025)},
    "ball_in_cup": {"catch": Rewards(catch, above)},
    "cheetah": {"run": _runs},
}
"""By domain and task; what depends on the model is a function of it."""
GYMNASIUM = {
    "Pendulum-v1": Rewards(swing_up),
    "InvertedPendulum-v5": Rewards(stand, upright, fallen),
    "Reacher-v5": Rewards(reach),
    "HalfCheetah-v5": Rewards(forward, forward_upright, ignored=[0]),
}
"""By id."""
