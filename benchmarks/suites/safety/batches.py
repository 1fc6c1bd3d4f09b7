"""Episodes of a world, without and with AFM, all situations and seeds in one batch."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from worlds import BOXES, NOMINAL, World

from afm_rl.correction import ActionFlow
from afm_rl.dynamics import KnownDynamics
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms.delay_compensation import state_at_arrival

SINCE = 60  # step at which faults begin, and from which costs count
WIFI = torch.tensor([0.3082, 0.5927, 0.0829, 0.0075, 0.0031, 0.0056])  # of 1 to 6 steps
LONGEST = len(WIFI)  # delay, steps
SWING = 2 * math.pi / 25  # of a payload, per step
LATER = ("late", "least", "wifi", "dead", "levels", "lag", "sway")  # rules that begin then


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
        seeds: of each; random numbers depend only on the seed.
        settings: of the correction; None: no correction.
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
    """Return the costs of :func:`play` if the correction knows action bounds."""
    rules = rules_of(situations, seeds)
    count, limit = len(situations) * seeds, world.limit
    streams = [torch.Generator().manual_seed(k) for k in range(3)]

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
    error, force = torch.zeros_like(state), torch.zeros(count, max(3, len(limit)))
    actuators, alike = (
        Actuators(held, world),
        (torch.arange(len(limit)) == 0) | (rules["alone"] == 0),
    )
    for step in range(world.steps):
        time = step - SINCE
        seen, later = reading, 0
        if memory is not None:
            late = corrector.delay_in(memory)
            seen, later = state_at_arrival(corrector, memory, model, late)
            later = later.unsqueeze(-1)
        planned = world.policy(seen, step + later)
        planned = torch.where(rules["bang"] > 0, limit * planned.sign(), planned)
        planned = (planned + (-1) ** step * alike * rules["chatter"] * limit).clamp(-limit, limit)
        later = torch.tensor(time >= 0)
        planned = torch.where((rules["zero"] > 0) & later, 0.0, planned)
        held = planned if time <= 0 else held
        planned = torch.where((rules["constant"] > 0) & later, held, planned)
        executed = planned
        if corrector is not None:
            memory, correction = corrector.correct(memory, middle + unit * planned, model, box)
            executed = ((correction.executed_action - middle) / unit).clamp(-limit, limit)
        now = rules_at(rules, time, world.dt, draw(torch.randn, 1, stream=1))
        effect = actuators(executed, now, draw(torch.rand, 1, stream=2))
        force = shocks(force)
        after = world.move(state, effect, now, force)
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


class Actuators:
    """The effects of commands ``(N, A)``, step by step.

    In this order: they are late, have backlash, stick, have a dead zone, few levels, a gain and a
    lag, and carry a payload that swings.
    """

    def __init__(self, command: Tensor, world: World) -> None:
        self.limit, self.zero = world.limit, world.zero * world.limit
        self.arriving = command.new_full((LONGEST + 1, *command.shape), math.nan)
        self.arrived = self.given = self.effect = command
        self.angle = self.rate = torch.zeros_like(command)

    def __call__(self, command: Tensor, rules: dict[str, Tensor], luck: Tensor) -> Tensor:
        """Return the effects of commands, by the current rules; luck is uniform, ``(N, 1)``."""
        r, limit = rules, self.limit
        radio = 1 + (luck > WIFI.cumsum(0)).sum(-1, keepdim=True)
        steps = torch.where(r["wifi"] > 0, radio, r["least"] + luck * (1 + r["late"] - r["least"]))
        delay = torch.arange(LONGEST + 1)[:, None, None]
        self.arriving = torch.where(delay == steps.long(), command, self.arriving)
        now, later = self.arriving[0], self.arriving[1:]
        self.arrived = torch.where(now.isnan(), self.arrived, now)
        self.arriving = torch.cat([later, torch.full_like(now, math.nan).unsqueeze(0)])
        low, high = (self.arrived + side * r["backlash"] * limit for side in (-1, 1))
        pulled = torch.minimum(torch.maximum(self.given, low), high)
        self.given = torch.where(
            (pulled - self.given).abs() < r["stick"] * limit, self.given, pulled
        )
        acting = self.given.sign() * (self.given.abs() - r["dead"] * limit).clamp_min(0.0)
        size = r["levels"] * limit
        acting = torch.where(size > 0, (acting / size.clamp_min(1e-6)).round() * size, acting)
        away = acting - self.zero
        away = r["gain"] * torch.where(away > 0, r["up"], 1.0) * away + self.zero
        self.effect = self.effect + (away - self.effect) / (1 + r["lag"])
        effect = self.effect - r["sway"] * self.angle
        self.rate = self.rate + SWING**2 * (effect - self.angle) - 0.05 * SWING * self.rate
        self.angle = self.angle + self.rate
        return effect


def rules_of(situations: Sequence[dict[str, float]], seeds: int) -> dict[str, Tensor]:
    """Return rules by name, ``(N, 1)``, the seeds of a situation one after the other."""
    return {
        name: torch.tensor([float(given.get(name, value)) for given in situations])
        .repeat_interleave(seeds)
        .unsqueeze(-1)
        for name, value in NOMINAL.items()
    }


def rules_at(rules: dict[str, Tensor], time: int, dt: float, luck: Tensor) -> dict[str, Tensor]:
    """Return the rules at a step, counted from :data:`SINCE`, with faults that begin, end and grow.

    >>> fault = rules_of([{"gain": -1.0, "lasts": 20, "every": 60}], seeds=1)
    >>> [rules_at(fault, time, 1.0, torch.zeros(1, 1))["gain"].item() for time in (-1, 0, 20, 60)]
    [1.0, -1.0, 1.0, -1.0]
    """
    r, since = rules, torch.tensor(float(max(0, time)))
    swing = r["swing"] * (2 * math.pi * time / r["period"]).sin()
    share = ((time + 1) / r["over"]).clamp(0, 1) * (since.remainder(r["every"]) < r["lasts"])
    gain = (1 + share * (r["gain"] - 1)) * (r["then"] if time >= 60 else 1.0)
    later = {name: share * r[name] for name in LATER} | {"up": 1 + share * (r["up"] - 1)}
    return (
        r
        | later
        | {
            "wind": r["wind"] + swing + 0.01 * r["ramp"] * since,
            "gain": gain * (1 - r["fade"] * dt * (time + SINCE)).clamp_min(0.2),
            "mass": r["mass"] * (r["load"] if 20 <= time < 60 else 1.0),
            "dt": r["dt"] * (1 + r["jitter"] * luck).clamp_min(0.1),
            "jump": torch.full_like(r["mass"], float(time == 5)),
        }
    )
