"""Tasks of the Actuator Inversion Benchmark: bodies of other lengths, and reversed actuators.

Benad et al. 2026, "Dynamics-Aligned Shared Hypernetworks for Contextual RL under Discontinuous
Shifts", arXiv 2602.06550.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, cast
from xml.etree import ElementTree

import numpy as np
import torch
from torch import Tensor

from afm_rl.dynamics import KnownDynamics
from afm_rl.dynamics.mujoco_physics import NAMES, changed_model
from afm_rl.envs.task import Contexts, Reward, Task
from afm_rl.envs.task_sources import NOWHERE, Limits, dm_control_task, quiet, trust
from afm_rl.errors import check_choice, check_count
from afm_rl.manifold import Manifold

VALUES = 50  # of a parameter, in each split
LEGS = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
LOWER = ("bshin", "bfoot", "fshin", "ffoot")
STEP = 0.1  # s, of the double integrator
Span = tuple[float, float]


def spread(inner: Span, outer: Span) -> dict[str, np.ndarray]:
    """Return 50 values of a parameter for each split, from its training and its whole range.

    >>> {name: values[[0, -1]].round(3).tolist() for name, values in spread((1, 2), (0, 4)).items()}
    {'train': [1.0, 2.0], 'in': [1.01, 1.99], 'out': [0.0, 4.0]}
    """
    low, high = inner
    margin, half = 0.01 * (high - low), VALUES // 2
    below = np.linspace(outer[0], low, half, endpoint=False)
    above = np.linspace(outer[1], high, half, endpoint=False)[::-1]
    return {
        "train": np.linspace(low, high, VALUES),
        "in": np.linspace(low + margin, high - margin, VALUES),
        "out": np.concatenate([below, above]),
    }


def contexts_of(
    spans: Mapping[str, tuple[Span, Span]],
    regime: Callable[..., Mapping[str, float]],
    signs: Sequence[float],
    count: int,
) -> Contexts:
    """Return pairs of regimes, before and after a change, of each split.

    The values of all parameters are crossed, with the signs too, sorted, and ``count`` of them
    taken at equal distances. ``train``, ``in`` and ``out`` are as published, with both signs;
    ``train_reversed`` and so on have the reversed one alone; ``nominal`` and ``reversed`` are the
    nominal body.

    Args:
        spans: training and whole range of each parameter.
        regime: ``regime(sign, *values)``; without values that of the nominal body.
        signs: of the actions.
        count: contexts of a split.
    """
    found: dict[str, list] = {"nominal": [({}, {})], "reversed": [({}, regime(-1.0))]}
    splits = [spread(*span) for span in spans.values()]
    for name in splits[0]:
        values = np.meshgrid(*(split[name] for split in splits), indexing="ij")
        grid = np.stack([part.ravel() for part in values], -1)
        for suffix, own in (("", signs), ("_reversed", (-1.0,))):
            rows = [(*row, sign) for row in grid.tolist() for sign in sorted(own)]
            chosen = np.linspace(0, len(rows) - 1, count).round().astype(int)
            found[name + suffix] = [
                (regime(1.0, *row), regime(sign, *row))
                for *row, sign in (rows[index] for index in chosen)
            ]
    return found


def body_regime(size: int, sign: float, *values: float, **units: float) -> dict[str, float]:
    """Return the regime of a body with A = ``size`` actuators; ``units`` are nominal values.

    >>> body_regime(1, -1.0, 0.75, length=0.5)
    {'length': 1.5, 'gain_0': -1.0}
    """
    pairs = zip(values, units.items(), strict=False)  # no values: the nominal ones
    factors = {name: value / unit for value, (name, unit) in pairs}
    return factors | ({} if sign == 1 else {f"gain_{axis}": sign for axis in range(size)})


def stretched(domain: str, model: Any, row: tuple[float, ...]) -> Any:
    """Return a model of dm_control's domain with other physics, whose MJCF says the lengths.

    Masses follow from the density where the MJCF gives none.

    Args:
        domain: such as ``reacher``.
        model: the nominal ``MjModel``.
        row: values of :attr:`Physics.names <afm_rl.regimes.Physics>`.
    """
    import mujoco
    from dm_control.suite import common

    value = dict(zip(NAMES, row, strict=True))
    root = ElementTree.fromstring(common.read_model(f"{domain}.xml"))
    for element, attribute, index in EDITS[domain](root):
        numbers = [float(word) for word in element.get(attribute).split()]
        numbers[index] *= value["length"]
        element.set(attribute, " ".join(repr(number) for number in numbers))
    with quiet():
        text = ElementTree.tostring(root, encoding="unicode")
        found = mujoco.MjModel.from_xml_string(text, dict(common.ASSETS))
    found.opt.disableflags = model.opt.disableflags
    rest = tuple({**value, "length": 1.0}.values())
    return changed_model(found, rest)


def _named(root: Any, kind: str, names: Sequence[str]) -> list[Any]:
    return [root.find(f".//{kind}[@name='{name}']") for name in names]


Edits = Iterator[tuple[Any, str, int]]


def _pole(root: Any) -> Edits:
    yield root.find(".//default[@class='pole']/geom"), "fromto", 5


def _arm(root: Any) -> Edits:
    for body in _named(root, "body", ("hand", "finger")):
        yield body, "pos", 0
    for geom in _named(root, "geom", ("arm", "hand")):
        yield geom, "fromto", 3


def _legs(root: Any) -> Edits:
    for geom in _named(root, "geom", LEGS):
        yield geom, "size", 1
    for part in (*_named(root, "geom", LEGS), *_named(root, "body", LOWER)):
        yield part, "pos", 0
        yield part, "pos", 2


EDITS: dict[str, Callable[[Any], Edits]] = {"cartpole": _pole, "reacher": _arm, "cheetah": _legs}
BODIES: dict[str, tuple[str, str, dict[str, float], dict[str, tuple[Span, Span]]]] = {
    "cartpole": ("cartpole", "balance", {"length": 0.5}, {"length": ((0.3, 0.85), (0.1, 2.0))}),
    "reacher_easy": ("reacher", "easy", {"length": 1.0}, {"length": ((0.8, 1.2), (0.4, 1.6))}),
    "reacher_hard": ("reacher", "hard", {"length": 1.0}, {"length": ((0.8, 1.2), (0.4, 1.6))}),
    "cheetah": ("cheetah", "run", {"length": 1.0}, {"length": ((0.8, 1.2), (0.4, 1.6))}),
    "ball_in_cup": (
        "ball_in_cup",
        "catch",
        {"gravity": 9.81, "length": 0.3},
        {"gravity": ((8.0, 12.0), (1.0, 20.0)), "length": ((0.24, 0.36), (0.1, 0.5))},
    ),
}
"""Domain and task of dm_control, the nominal values, and their ranges: training, and whole."""


def glide(state: Tensor, action: Tensor) -> Tensor:
    """Step of the double integrator: places, then speeds; a unit mass, forces up to 1.

    >>> glide(torch.tensor([0.5, 0.0, 1.0, 0.0]), torch.tensor([0.0, 0.5]))
    tensor([0.6000, 0.0000, 1.0000, 0.0500])
    """
    place, speed = state.chunk(2, -1)
    return torch.cat([place + STEP * speed, speed + STEP * action], -1).clamp(-1.0, 1.0)


def at_origin(state: Tensor, action: Tensor, after: Tensor) -> Tensor:
    """Reward of the double integrator: 1 within 0.1 of the origin."""
    return (after[..., :2].norm(dim=-1) <= 0.1).to(after)


def corner(seed: int) -> tuple[Tensor, Tensor]:
    """Return a start of the double integrator: both places beyond 0.8, speeds anything."""
    drawn = 2 * torch.rand(6, generator=torch.Generator().manual_seed(seed)) - 1
    places = drawn[:2].sign() * (0.8 + 0.2 * drawn[2:4].abs())
    return torch.cat([places, drawn[4:]]), NOWHERE


def integrator_regime(sign: float, mass: float = 1.0) -> dict[str, float]:
    """Return the regime of a mass: what a force does is divided by it."""
    gain = sign / mass
    return {} if gain == 1 else {"gain_0": gain, "gain_1": gain}


def integrator(contexts: int) -> Task:
    """Return the double integrator."""
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
        contexts=contexts_of(
            {"mass": ((0.5, 1.5), (0.1, 2.0))}, integrator_regime, (1.0, -1.0), contexts
        ),
    )


def actuator_inversion_task(
    task: str = "cartpole",
    contexts: int = 20,
    steps: int | None = None,
    reward: Reward | None = None,
    action_low: Limits = None,
    action_high: Limits = None,
) -> Task:
    """Return a task of the benchmark.

    Its families of regimes are the benchmark's splits, see :func:`contexts_of`; a mission's seed
    says which context it has.

    Args:
        task: ``cartpole``, ``reacher_easy``, ``reacher_hard``, ``cheetah``, ``ball_in_cup``, which
            need dm_control, or ``double_integrator``.
        contexts: of each split.
        steps: length of an episode; as published if None.
        reward: to plan with; the task's own if None.
        action_low: lowest action; the task's if None.
        action_high: highest action.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> task = actuator_inversion_task("double_integrator")
    >>> task.contexts["out_reversed"][0]
    ({'gain_0': 10.0, 'gain_1': 10.0}, {'gain_0': -10.0, 'gain_1': -10.0})
    """
    check_choice("robot.task", task, (*BODIES, "double_integrator"))
    check_count("robot.contexts", contexts)
    if task == "double_integrator":
        found = integrator(contexts)
    else:
        domain, name, nominal, spans = BODIES[task]
        change = partial(stretched, domain) if domain in EDITS else changed_model
        found = dm_control_task(domain, name, change=change)
        trust(cast(KnownDynamics, found.world), found.start(0)[0], found.low, found.high)
        signs = (1.0, -1.0) if domain in EDITS else (1.0,)
        regime = partial(body_regime, len(found.low), **nominal)
        found = replace(found, contexts=contexts_of(spans, regime, signs, contexts))
    return replace(
        found,
        plan=found.plan if reward is None else reward,
        low=action_low or found.low,
        high=action_high or found.high,
        steps=found.steps if steps is None else check_count("robot.steps", steps),
    )
