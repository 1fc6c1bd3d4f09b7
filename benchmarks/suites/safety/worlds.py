"""Robots as batches: every row is an episode with a disturbance of its own.

A world is the real robot; the correction has only the step function that a user would write, and
the state of the sensor. Nothing here is a fault of the actuators, unless the name says so. Forces
are in units of each robot; steps are counted from a third of the episode on.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

NOMINAL = {
    "push": 0.0,  # jump of a speed at a third of the episode
    "teleport": 0.0,  # jump of a position there
    "gust": 0.0,  # standard deviation of a force at every step
    "wind": 0.0,  # constant force
    "swing": 0.0,  # largest force that oscillates
    "period": 60.0,  # of it, steps
    "ramp": 0.0,  # what a force grows by in 100 steps
    "noise": 0.0,  # standard deviation of the sensor
    "colour": 0.0,  # correlation of noise and gusts from step to step
    "tails": 0.0,  # have they a Student's t distribution with two degrees of freedom?
    "outliers": 0.0,  # share of readings that are off by a lot
    "quantum": 0.0,  # of the readings
    "stale": 0.0,  # share of readings that are sent twice
    "gap": 0.0,  # steps of every 40 in which the last reading is repeated
    "lost": 0.0,  # share of readings that are not a number; the policy keeps the last one
    "wall": math.inf,  # where the robot is stopped
    "stall": 0.0,  # share of the steps in which it stands still
    "fade": 0.0,  # of the actuators, per second
    "gain": 1.0,  # of the actuators, from step 0 on
    "over": 1.0,  # steps in which it is reached
    "lasts": 1e9,  # steps that it lasts
    "every": 1e9,  # steps after which it comes again
    "then": 1.0,  # factor on it from step 60 on
    "stick": 0.0,  # change of a command that has no effect, a share of the largest
    "backlash": 0.0,  # half of what a command must go back until it acts, likewise
    "mass": 1.0,
    "load": 1.0,  # factor on the mass from step 20 to 60
    "gravity": 1.0,
    "length": 1.0,
    "friction": 0.0,
    "dt": 1.0,  # of the world, relative to what the model believes
    "jitter": 0.0,  # its standard deviation
    "zero": 0.0,  # is the command zero from a third of the episode on?
    "constant": 0.0,  # is it the one of then?
    "bang": 0.0,  # is it at a limit, always?
    "chatter": 0.0,  # what is added, and subtracted at every other step, a share of the largest
    "alone": 0.0,  # does the first actuator's command chatter, and no other?
    "late": 0.0,  # longest delay of a command, steps; each has one of its own
    "least": 0.0,  # shortest
    "wifi": 0.0,  # are delays those of packets by radio?
    "dead": 0.0,  # command that has no effect, a share of the largest
    "levels": 0.0,  # distance of the commands that there are, likewise
    "up": 1.0,  # factor on the gain of commands above zero
    "lag": 0.0,  # steps that the actuators' effect lags behind
    "sway": 0.0,  # mass of a payload that swings, of the robot's
    "box": 0.0,  # the unit in which actions are given: a number of BOXES
}
BOXES = (-1.0, 1.0), (0.0, 1.0), (-1e-3, 1e-3), (-1e3, 1e3)  # of every action; 0: a robot's own


@dataclass
class World:
    """A robot: its step function, its policy, its cost.

    Args:
        dt: of the model (s).
        limit: largest action, ``(A,)``.
        step: model of the user: state and action to the next state.
        move: the real step: state, action, rules by name ``(N, 1)``, random numbers, time.
        read: the sensor's noise scale of each coordinate, ``(S,)``.
        policy: action of a reading and the time.
        cost: of a state and the time, ``(N,)``.
        start: first states, of a number and a generator.
        steps: of an episode.
        zero: command that has no effect, a share of the largest.
    """

    dt: float
    limit: Tensor
    step: Callable
    move: Callable
    read: Tensor
    policy: Callable
    cost: Callable
    start: Callable
    steps: int
    zero: float = 0.0


def pendulum() -> World:
    """Return gymnasium's pendulum, held upright by a saturated PD."""
    limit, dt = torch.tensor([2.0]), 0.05

    def step(state: Tensor, action: Tensor, g=10.0, m=1.0, l=1.0, rub=0.0, dt=dt) -> Tensor:
        angle = torch.atan2(state[..., 1:2], state[..., :1])
        torque = action - rub * state[..., 2:]
        pull = 3 * g / (2 * l) * angle.sin() + 3 / (m * l**2) * torque
        speed = (state[..., 2:] + pull * dt).clamp(-8, 8)
        angle = angle + speed * dt
        return torch.cat([angle.cos(), angle.sin(), speed], -1)

    def move(state: Tensor, action: Tensor, rules: dict[str, Tensor], draw: Tensor) -> Tensor:
        r = rules
        action = action + r["wind"]
        after = step(
            state, action, 10 * r["gravity"], r["mass"], r["length"], r["friction"], dt * r["dt"]
        )
        speed = after[..., 2:] + r["gust"] * draw[..., :1] + r["jump"] * r["push"]
        angle = torch.atan2(after[..., 1:2], after[..., :1]) + r["jump"] * r["teleport"]
        stopped = angle.abs() > r["wall"]
        angle = torch.where(stopped, angle.clamp(-r["wall"], r["wall"]), angle)
        speed = torch.where(stopped, 0.0, speed).clamp(-8, 8)
        return torch.cat([angle.cos(), angle.sin(), speed], -1)

    def policy(state: Tensor, time: int) -> Tensor:
        angle = torch.atan2(state[..., 1:2], state[..., :1])
        return (-10 * angle - 2.5 * state[..., 2:]).clamp(-limit, limit)

    def cost(state: Tensor, time: int) -> Tensor:
        angle = torch.atan2(state[..., 1], state[..., 0])
        return angle.square() + 0.1 * state[..., 2].square()

    def start(count: int, generator: torch.Generator) -> Tensor:
        angle, speed = 0.25 * (2 * torch.rand(2, count, 1, generator=generator) - 1)
        return torch.cat([angle.cos(), angle.sin(), speed], -1)

    read = torch.tensor([0.3, 0.3, 1.0])
    return World(dt, limit, step, move, read, policy, cost, start, 200)


def ground() -> World:
    """Return a ground robot that follows a point on a circle."""
    limit, dt = torch.tensor([1.0, 1.5]), 0.2

    def step(state: Tensor, action: Tensor, dt=dt) -> Tensor:
        x, y, heading = state.unbind(-1)
        v, turn = action.unbind(-1)
        dt = torch.as_tensor(dt).reshape(-1) if isinstance(dt, Tensor) else dt
        middle = heading + 0.5 * turn * dt
        after = [x + v * dt * middle.cos(), y + v * dt * middle.sin(), heading + turn * dt]
        return torch.stack(after, -1)

    def move(state: Tensor, action: Tensor, rules: dict[str, Tensor], draw: Tensor) -> Tensor:
        r = rules
        action = action / r["mass"]  # heavier: slower
        action = action - r["friction"] * 0.3 * action.tanh()
        action = action * torch.cat([torch.ones_like(r["length"]), 1 / r["length"]], -1)
        after = step(state, action, dt * r["dt"])
        ahead = torch.tensor([1.0, 1.0, 0.3])
        after = after + dt * (r["gust"] * draw[..., :3] * ahead)
        after = after + dt * r["wind"] * torch.tensor([1.0, 0.5, 0.0])
        sink = r["gravity"] - 1  # a slope
        after = after + dt * sink * torch.tensor([0.0, -1.0, 0.0])
        after = after + r["jump"] * (r["push"] + r["teleport"]) * torch.tensor([0.3, -0.3, 0.3])
        place = after[..., :2].clamp(-r["wall"], r["wall"])
        return torch.cat([place, after[..., 2:]], -1)

    def goal(time: Tensor | int) -> Tensor:
        angle = 0.15 * dt * torch.as_tensor(time).reshape(-1, 1)
        return torch.cat([2 * angle.cos() - 2, 2 * angle.sin()], -1)

    def policy(state: Tensor, time: int) -> Tensor:
        ahead = (goal(time + 1) - goal(time)) / dt
        pull = ahead + 1.5 * (goal(time) - state[..., :2])  # the velocity that is wanted
        away = torch.atan2(pull[..., 1], pull[..., 0]) - state[..., 2]
        away = torch.remainder(away + math.pi, 2 * math.pi) - math.pi
        speed = pull.norm(dim=-1) * away.cos()
        return torch.stack([speed, 2.0 * away + 0.15], -1).clamp(-limit, limit)

    def cost(state: Tensor, time: int) -> Tensor:
        return (goal(time) - state[..., :2]).norm(dim=-1)

    def start(count: int, generator: torch.Generator) -> Tensor:
        place = 0.5 * (2 * torch.rand(count, 2, generator=generator) - 1)
        heading = math.pi * (2 * torch.rand(count, 1, generator=generator) - 1)
        return torch.cat([place, heading], -1)

    read = torch.tensor([1.0, 1.0, 1.0])
    return World(dt, limit, step, move, read, policy, cost, start, 200)


def servos(joints: int) -> World:
    """Return servos that hang down a little, and follow two sines each, not all alike."""
    limit, number = torch.ones(joints), torch.arange(joints)

    def step(state: Tensor, action: Tensor, load=1.0, rate=0.5) -> Tensor:
        return state + rate * (action - state) - 0.05 * load * state.sin()

    def move(state: Tensor, action: Tensor, rules: dict[str, Tensor], draw: Tensor) -> Tensor:
        r = rules
        away = action + 0.5 * r["wind"] - state
        away = away - 0.1 * r["friction"] * (10 * away).tanh()
        load = r["mass"] * r["gravity"] * r["length"]
        after = step(state, state + away, load, 0.5 * r["dt"] / r["mass"])
        after = after + 0.1 * r["gust"] * draw[..., :joints]
        after = after + r["jump"] * (0.1 * r["push"] + 0.3 * r["teleport"])
        return after.clamp(-r["wall"], r["wall"])

    def reference(time: int) -> Tensor:
        angle = 0.03 * (1 + 0.3 * (number % 6)) * time + 1.3 * number
        return 0.5 * angle.sin() + 0.15 * (2.7 * angle).sin()

    def policy(state: Tensor, time: int) -> Tensor:
        return (2 * reference(time + 1) - state).clamp(-limit, limit)

    def cost(state: Tensor, time: int) -> Tensor:
        return (state - reference(time)).abs().mean(-1)

    def start(count: int, generator: torch.Generator) -> Tensor:
        return reference(0) + 0.1 * torch.randn(count, joints, generator=generator)

    read = torch.full((joints,), 0.1)
    return World(1.0, limit, step, move, read, policy, cost, start, 200)


def cart(stiffness: float = 0.0) -> World:
    """Return a cart, with a spring or without, that follows a sine."""
    limit, dt = torch.ones(1), 0.1

    def step(state: Tensor, action: Tensor) -> Tensor:
        place, speed = state.split(1, -1)
        speed = speed + dt * (action - stiffness * place)
        return torch.cat([place + dt * speed, speed], -1)

    def reference(time: Tensor | int) -> Tensor:
        return 0.3 * (0.04 * torch.as_tensor(time)).sin()

    def policy(state: Tensor, time: Tensor | int) -> Tensor:
        place, speed = state.split(1, -1)
        aim, ahead = reference(time), (reference(time + 1) - reference(time)) / dt
        push = stiffness * aim + 1.5 * (aim - place) + 1.8 * (ahead - speed)
        return push.clamp(-limit, limit)

    def cost(state: Tensor, time: int) -> Tensor:
        return (state[..., 0] - reference(time)).abs()

    def start(count: int, generator: torch.Generator) -> Tensor:
        return 0.1 * torch.randn(count, 2, generator=generator)

    return World(dt, limit, step, pushed(step), torch.ones(2), policy, cost, start, 260)


def quadrotor() -> World:
    """Return a quadrotor in a plane that follows an eight: two thrusts around those of hovering."""
    limit, dt, g = torch.ones(2), 0.05, 10.0

    def step(state: Tensor, action: Tensor) -> Tensor:
        place, angle, speed, spin = state.split([2, 1, 2, 1], -1)
        left, right = action.split(1, -1)
        thrust = g * (1 + 0.5 * (left + right))
        pull = torch.cat([-thrust * angle.sin(), thrust * angle.cos() - g], -1)
        speed, spin = speed + dt * pull, spin + dt * 20 * (right - left)
        return torch.cat([place + dt * speed, angle + dt * spin, speed, spin], -1)

    def reference(time: Tensor | int) -> Tensor:
        angle = 0.03 * torch.as_tensor(time).reshape(-1, 1)
        return torch.cat([angle.sin(), 0.5 * (2 * angle).sin()], -1)

    def policy(state: Tensor, time: Tensor | int) -> Tensor:
        place, angle, speed, spin = state.split([2, 1, 2, 1], -1)
        x, z = (2 * (reference(time) - place) - 2.2 * speed).split(1, -1)
        turn = (25 * ((-x / g).clamp(-0.5, 0.5) - angle) - 8 * spin) / 40
        return torch.cat([z / g - turn, z / g + turn], -1).clamp(-limit, limit)

    def cost(state: Tensor, time: int) -> Tensor:
        return (reference(time) - state[..., :2]).norm(dim=-1).clamp_max(3.0)

    def start(count: int, generator: torch.Generator) -> Tensor:
        return 0.1 * torch.randn(count, 6, generator=generator)

    return World(dt, limit, step, pushed(step), torch.ones(6), policy, cost, start, 260)


def heater() -> World:
    """Return a heater that follows a sine; it is off at the lowest command."""
    limit, dt = torch.ones(1), 0.05

    def step(state: Tensor, action: Tensor) -> Tensor:
        return state + dt * (1.5 * (1 + action) - state)

    def reference(time: Tensor | int) -> Tensor:
        return 1.5 + 0.5 * (0.04 * torch.as_tensor(time)).sin()

    def policy(state: Tensor, time: Tensor | int) -> Tensor:
        aim = reference(time)
        return (aim / 1.5 - 1 + 4 * (aim - state)).clamp(-limit, limit)

    def cost(state: Tensor, time: int) -> Tensor:
        return (state[..., 0] - reference(time)).abs()

    def start(count: int, generator: torch.Generator) -> Tensor:
        return 1.5 + 0.1 * torch.randn(count, 1, generator=generator)

    return World(dt, limit, step, pushed(step), torch.ones(1), policy, cost, start, 260, -1.0)


def pushed(step: Callable) -> Callable:
    """Return what happens to a robot whose actuators are disturbed, and nothing else."""

    def move(state: Tensor, action: Tensor, rules: dict[str, Tensor], draw: Tensor) -> Tensor:
        return step(state, action + rules["gust"] * draw[..., : action.shape[-1]])

    return move


WORLDS: dict[str, Callable[[], World]] = {
    "pendulum": pendulum,
    "ground robot": ground,
    "one servo": partial(servos, 1),
    "6 servos": partial(servos, 6),
    "30 servos": partial(servos, 30),
}
ACTUATED: dict[str, Callable[[], World]] = {
    "mass-spring": partial(cart, 2.0),
    "cart": cart,
    "differential drive": ground,
    "planar quadrotor": quadrotor,
    "heater": heater,
}
SITUATIONS: dict[str, dict[str, float]] = {
    "healthy": {},
    "push 2": {"push": 2.0},
    "push 5": {"push": 5.0},
    "teleport 0.5": {"teleport": 0.5},
    "teleport 2": {"teleport": 2.0},
    "gust 0.1": {"gust": 0.1},
    "gust 0.3": {"gust": 0.3},
    "gust 1": {"gust": 1.0},
    "wind 0.1": {"wind": 0.1},
    "wind 0.3": {"wind": 0.3},
    "noise 0.01": {"noise": 0.01},
    "noise 0.05": {"noise": 0.05},
    "noise 0.2": {"noise": 0.2},
    "noise 0.1": {"noise": 0.1},
    "outliers 1 %": {"outliers": 0.01},
    "outliers 5 %": {"outliers": 0.05},
    "quantised 0.05": {"quantum": 0.05},
    "stale 20 %": {"stale": 0.2},
    "wall": {"wall": 0.25},
    "stall 10 %": {"stall": 0.1},
    "fading": {"fade": 0.05},
    "mass x 1.3": {"mass": 1.3},
    "mass x 0.7": {"mass": 0.7},
    "gravity x 1.2": {"gravity": 1.2},
    "gravity x 0.8": {"gravity": 0.8},
    "friction 0.3": {"friction": 0.3},
    "friction 1": {"friction": 1.0},
    "length x 1.3": {"length": 1.3},
    "length x 0.8": {"length": 0.8},
    "dt x 0.7": {"dt": 0.7},
    "dt x 1.4": {"dt": 1.4},
    "zero commands": {"zero": 1.0},
    "constant commands": {"constant": 1.0},
    "bang-bang": {"bang": 1.0},
    "bang-bang, noise 0.2": {"bang": 1.0, "noise": 0.2},
    "friction 0.3, noise 0.05": {"friction": 0.3, "noise": 0.05},
    **{
        f"force {size} that oscillates in {period} steps": {"swing": size, "period": period}
        for size in (0.1, 0.3, 0.6)
        for period in (15, 30, 60, 120)
    },
    "force grows by 0.2 in 100 steps": {"ramp": 0.2},
    "force grows by 0.6 in 100 steps": {"ramp": 0.6},
    "stiction 0.02": {"stick": 0.02},
    "stiction 0.05": {"stick": 0.05},
    "stiction 0.1": {"stick": 0.1},
    "backlash 0.02": {"backlash": 0.02},
    "backlash 0.1": {"backlash": 0.1},
    "payload x 1.5, dropped": {"load": 1.5},
    "payload x 3, dropped": {"load": 3.0},
    "wall at 0.1": {"wall": 0.1},
    "wall at 1": {"wall": 1.0},
    "no reading for 5 of 40 steps": {"gap": 5},
    "no reading for 10 of 40 steps": {"gap": 10},
    "10 % of readings lost": {"lost": 0.1},
    "reversed for 20 of 60 steps": {"gain": -1, "lasts": 20, "every": 60},
    "reversed for 50 of 100 steps": {"gain": -1, "lasts": 50, "every": 100},
    "gain 0.3 for 20 of 60 steps": {"gain": 0.3, "lasts": 20, "every": 60},
    "gain 0.3 for 50 of 100 steps": {"gain": 0.3, "lasts": 50, "every": 100},
    "gain from 1 to -1 in 100 steps": {"gain": -1, "over": 100},
    "gain 0.5, then -0.5": {"gain": 0.5, "then": -1},
    "gain -1, then -0.5": {"gain": -1, "then": 0.5},
    "chattering 0.3": {"chatter": 0.3},
    "chattering 1": {"chatter": 1.0},
    "bang-bang, gain 0.5": {"bang": 1.0, "gain": 0.5},
    "dt jitters by 10 %": {"jitter": 0.1},
    "dt jitters by 30 %": {"jitter": 0.3},
    "noise 0.05, coloured": {"noise": 0.05, "colour": 0.9},
    "noise 0.05, heavy tails": {"noise": 0.05, "tails": 1.0},
    "gust 0.3, coloured": {"gust": 0.3, "colour": 0.9},
    "gust 0.1, heavy tails": {"gust": 0.1, "tails": 1.0},
    **{
        f"actions from {BOXES[box][0]:g} to {BOXES[box][1]:g}, {name}": {"box": box, **rules}
        for box in (1, 2, 3)
        for name, rules in {
            "healthy": {},
            "wind 0.3": {"wind": 0.3},
            "noise 0.05": {"noise": 0.05},
            "reversed": {"gain": -1.0},
        }.items()
    },
}
GUST = {"gust": 0.02}  # without it, all seeds are alike
PLANS = ("bang", "zero", "constant", "chatter", "alone", "box", "gust")  # rules of no fault
ACTUATORS: dict[str, dict[str, float]] = {
    f"{group}: {name}": GUST | rules
    for group, situations in {
        "healthy": {"": {}},
        "chatter with lag": {
            f"{size}, {lag} steps": {"chatter": size, "lag": lag}
            for size in (0.1, 0.2, 0.3, 0.5)
            for lag in (1, 2, 3, 4, 5)
        },
        "chatter on one axis": {
            f"{size}, lag of 2": {"chatter": size, "lag": 2, "alone": 1} for size in (0.3, 0.5)
        },
        "chatter with a gain": {
            f"{size}, gain {gain}, lag of {lag}": {"chatter": size, "gain": gain, "lag": lag}
            for size in (0.3, 0.5)
            for gain in (0.5, -1)
            for lag in (0, 2)
        },
        "one-sided box": {
            f"{size}, lag of {lag}": {"chatter": size, "lag": lag, "box": 1}
            for size, lag in ((0.3, 1), (0.3, 2), (0.5, 2))
        },
        "changing delay": {"0 to 3 steps": {"late": 3}, "by radio": {"wifi": 1}},
        "changing delay, held": {"3 steps": {"late": 3, "least": 3}},
        "backlash": {str(width): {"backlash": width} for width in (0.1, 0.3)},
        "quantised": {str(size): {"levels": size} for size in (0.1, 0.3)},
        "dead zone": {str(size): {"dead": size} for size in (0.1, 0.2)},
        "swinging payload": {str(mass): {"sway": mass} for mass in (0.2, 0.5)},
        "gain above zero": {str(gain): {"up": gain} for gain in (0.5, 1.5, -1)},
    }.items()
    for name, rules in situations.items()
}
