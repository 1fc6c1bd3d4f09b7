"""Episodes of a world, alone and corrected, all situations and seeds in one batch."""

from __future__ import annotations

import torch
from torch import Tensor
from worlds import NOMINAL, World

from afm_rl.correction import ActionFlow, Corrector
from afm_rl.dynamics import KnownDynamics
from afm_rl.spaces.manifold import Manifold


def rules_of(situations: list[dict[str, float]], seeds: int) -> dict[str, Tensor]:
    """Return rules by name, ``(N, 1)``, the seeds of a situation one after the other."""
    return {
        name: torch.tensor([given.get(name, value) for given in situations])
        .repeat_interleave(seeds)
        .unsqueeze(-1)
        for name, value in NOMINAL.items()
    }


@torch.no_grad()
def play(
    world: World,
    situations: list[dict[str, float]],
    seeds: int,
    corrector: Corrector | None,
    fault: float = 1.0,
    since: int = 60,
) -> Tensor:
    """Return the mean cost a step after ``since``, ``(situations, seeds)``.

    Args:
        world: the robot.
        situations: rules that are not nominal.
        seeds: of each; random numbers are those of the seed, whatever the situation.
        corrector: None: the policy alone.
        fault: gain of the actuators from ``since`` on.
        since: step at which it begins, and from which costs count.
    """
    rules = rules_of(situations, seeds)
    count, size = len(situations) * seeds, len(world.limit)
    generator = torch.Generator().manual_seed(0)

    def draw(kind, *shape: int) -> Tensor:
        one = kind(seeds, *shape, generator=generator)
        return one.repeat(len(situations), *[1] * len(shape))

    state = world.start(seeds, generator).repeat(len(situations), 1)
    states = state.shape[-1]
    model = KnownDynamics(world.step, Manifold(states), size)
    box = torch.stack([-world.limit, world.limit]).expand(count, 2, size)
    reading = last = state
    memory = None if corrector is None else corrector.begin(reading)
    costs, held = torch.zeros(count), torch.zeros(count, size)
    for time in range(world.steps):
        planned = world.policy(reading, time)
        planned = torch.where(rules["bang"] > 0, world.limit * planned.sign(), planned)
        later = time >= since
        planned = torch.where((rules["zero"] > 0) & torch.tensor(later), 0.0, planned)
        held = planned if time <= since else held
        planned = torch.where((rules["constant"] > 0) & torch.tensor(later), held, planned)
        executed = planned
        if corrector is not None:
            memory, correction = corrector.correct(memory, planned, model, box)
            executed = correction.executed.clamp(-world.limit, world.limit)
        rules["jump"] = torch.full((count, 1), float(time == since + 5))
        gain = (1 - rules["fade"] * world.dt * time).clamp_min(0.2) * (fault if later else 1.0)
        after = world.move(state, gain * executed, rules, draw(torch.randn, 3))
        state = torch.where(draw(torch.rand, 1) < rules["stall"], state, after)
        seen = state + rules["noise"] * world.read * draw(torch.randn, states)
        wild = draw(torch.rand, 1) < rules["outliers"]
        seen = torch.where(wild, seen + 2 * world.read * draw(torch.randn, states), seen)
        step = rules["quantum"].clamp_min(1e-12) * world.read
        seen = torch.where(rules["quantum"] > 0, (seen / step).round() * step, seen)
        reading = torch.where(draw(torch.rand, 1) < rules["stale"], last, seen)
        last = reading
        if corrector is not None:
            memory = corrector.observe(memory, reading)
        if later:
            costs += world.cost(state, time + 1) / (world.steps - since)
    return costs.view(len(situations), seeds)


def flow_for(world: World, **settings) -> ActionFlow:
    """Return the universal flow for a world's actions."""
    return ActionFlow(-world.limit, world.limit, **settings)
