"""Episodes of a world, alone and corrected, all situations and seeds in one batch."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from worlds import BOXES, NOMINAL, World

from afm_rl.correction import ActionFlow
from afm_rl.dynamics import KnownDynamics
from afm_rl.spaces.manifold import Manifold

SINCE = 60  # step at which faults begin, and from which costs count


def play(
    world: World,
    situations: Sequence[dict[str, float]],
    seeds: int,
    settings: dict | None = None,
) -> Tensor:
    """Return the mean cost a step after :data:`SINCE`, ``(situations, seeds)``.

    Args:
        world: the robot.
        situations: rules that are not nominal.
        seeds: of each; random numbers are those of the seed, whatever the situation.
        settings: of the correction; None: the policy alone.
    """
    boxes = torch.tensor([int(rules.get("box", 0)) for rules in situations])
    costs = torch.zeros(len(situations), seeds)
    for box in boxes.unique().tolist():
        mine = (boxes == box).nonzero().flatten()
        together = [situations[k] for k in mine]
        costs[mine] = play_in_box(world, together, seeds, settings, BOXES[box] if box else None)
    return costs


@torch.no_grad()
def play_in_box(
    world: World,
    situations: Sequence[dict[str, float]],
    seeds: int,
    settings: dict | None,
    ends: tuple[float, float] | None,
) -> Tensor:
    """Return the costs of :func:`play` where the correction knows actions between two ends."""
    rules = rules_of(situations, seeds)
    count, limit = len(situations) * seeds, world.limit
    streams = [torch.Generator().manual_seed(k) for k in (0, 1)]

    def draw(kind, *shape: int, stream: int = 0) -> Tensor:
        one = kind(seeds, *shape, generator=streams[stream])
        return one.repeat(len(situations), *[1] * len(shape))

    def shocks(before: Tensor) -> Tensor:
        fresh, energy = draw(torch.randn, before.shape[-1]), draw(torch.rand, 1, stream=1)
        fresh = torch.where(rules["tails"] > 0, fresh / (-energy.log()).sqrt(), fresh)
        return rules["colour"] * before + (1 - rules["colour"].square()).sqrt() * fresh

    low, high = (-limit, limit) if ends is None else (torch.full_like(limit, end) for end in ends)
    middle, unit = 0.5 * (low + high), 0.5 * (high - low) / limit
    state = world.start(seeds, streams[0]).repeat(len(situations), 1)
    states = state.shape[-1]
    model = KnownDynamics(
        lambda state, action: world.step(state, (action - middle) / unit),
        Manifold(states),
        len(limit),
    )
    corrector = None if settings is None else ActionFlow(low, high, **settings)
    box = torch.stack([low, high]).expand(count, 2, len(limit))
    reading = state
    memory = None if corrector is None else corrector.begin(reading)
    costs, held = torch.zeros(count), torch.zeros(count, len(limit))
    given, error, force = held, torch.zeros_like(state), torch.zeros(count, max(3, len(limit)))
    for step in range(world.steps):
        time = step - SINCE
        planned = world.policy(reading, step)
        planned = torch.where(rules["bang"] > 0, limit * planned.sign(), planned)
        planned = (planned + (-1) ** step * rules["chatter"] * limit).clamp(-limit, limit)
        later = torch.tensor(time >= 0)
        planned = torch.where((rules["zero"] > 0) & later, 0.0, planned)
        held = planned if time <= 0 else held
        planned = torch.where((rules["constant"] > 0) & later, held, planned)
        executed = planned
        if corrector is not None:
            memory, correction = corrector.correct(memory, middle + unit * planned, model, box)
            executed = ((correction.executed - middle) / unit).clamp(-limit, limit)
        now = rules_at(rules, time, world.dt, draw(torch.randn, 1, stream=1))
        slack, band = now["backlash"] * limit, now["stick"] * limit
        pulled = torch.minimum(torch.maximum(given, executed - slack), executed + slack)
        given = torch.where((pulled - given).abs() < band, given, pulled)
        force = shocks(force)
        after = world.move(state, now["gain"] * given, now, force)
        state = torch.where(draw(torch.rand, 1) < rules["stall"], state, after)
        error = shocks(error)
        seen = state + rules["noise"] * world.read * error
        wild = draw(torch.rand, 1) < rules["outliers"]
        seen = torch.where(wild, seen + 2 * world.read * draw(torch.randn, states), seen)
        size = rules["quantum"].clamp_min(1e-12) * world.read
        seen = torch.where(rules["quantum"] > 0, (seen / size).round() * size, seen)
        stale = (draw(torch.rand, 1) < rules["stale"]) | (time % 40 < rules["gap"])
        seen = torch.where(stale, reading, seen)
        lost = draw(torch.rand, 1, stream=1) < rules["lost"]
        reading = torch.where(lost, reading, seen)
        if corrector is not None:
            memory = corrector.observe(memory, torch.where(lost, math.nan, seen))
        if time >= 0:
            costs += world.cost(state, step + 1) / (world.steps - SINCE)
    return costs.view(len(situations), seeds)


def rules_of(situations: Sequence[dict[str, float]], seeds: int) -> dict[str, Tensor]:
    """Return rules by name, ``(N, 1)``, the seeds of a situation one after the other."""
    return {
        name: torch.tensor([float(given.get(name, value)) for given in situations])
        .repeat_interleave(seeds)
        .unsqueeze(-1)
        for name, value in NOMINAL.items()
    }


def rules_at(rules: dict[str, Tensor], time: int, dt: float, luck: Tensor) -> dict[str, Tensor]:
    """Return what rules make of a step, counted from :data:`SINCE`: what comes, goes and grows.

    >>> fault = rules_of([{"gain": -1.0, "lasts": 20, "every": 60}], seeds=1)
    >>> [rules_at(fault, time, 1.0, torch.zeros(1, 1))["gain"].item() for time in (-1, 0, 20, 60)]
    [1.0, -1.0, 1.0, -1.0]
    """
    r, since = rules, torch.tensor(float(max(0, time)))
    swing = r["swing"] * (2 * math.pi * time / r["period"]).sin()
    share = ((time + 1) / r["over"]).clamp(0, 1) * (since.remainder(r["every"]) < r["lasts"])
    gain = (1 + share * (r["gain"] - 1)) * (r["then"] if time >= 60 else 1.0)
    return r | {
        "wind": r["wind"] + swing + 0.01 * r["ramp"] * since,
        "gain": gain * (1 - r["fade"] * dt * (time + SINCE)).clamp_min(0.2),
        "mass": r["mass"] * (r["load"] if 20 <= time < 60 else 1.0),
        "dt": r["dt"] * (1 + r["jitter"] * luck).clamp_min(0.1),
        "jump": torch.full_like(r["mass"], float(time == 5)),
    }
