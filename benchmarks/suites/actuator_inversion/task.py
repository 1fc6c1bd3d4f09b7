"""Tasks of the Actuator Inversion Benchmark: bodies of other lengths, and reversed actuators.

Benad et al. 2026, "Dynamics-Aligned Shared Hypernetworks for Contextual RL under Discontinuous
Shifts", arXiv 2602.06550.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, cast
from xml.etree import ElementTree

from actuator_inversion.contexts import Span, body_regime, contexts_of
from actuator_inversion.toys import SIGNS, TOYS
from afm_rl.dynamics import KnownDynamics
from afm_rl.dynamics.mujoco_model import changed_model
from afm_rl.envs import dm_control_task
from afm_rl.envs.task.own import Limits
from afm_rl.envs.task.published import quiet
from afm_rl.envs.task.task import Reward, Task, bound_noise
from afm_rl.errors import check_choice, check_count
from afm_rl.regimes import Physics

LEGS = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
LOWER = ("bshin", "bfoot", "fshin", "ffoot")


def stretched(domain: str, model: Any, row: tuple[float, ...]) -> Any:
    """Return a model of dm_control's domain with other physics; its MJCF has the lengths.

    Masses follow from the density if the MJCF has none.

    Args:
        domain: such as ``reacher``.
        model: the nominal ``MjModel``.
        row: values of :attr:`Physics.names <afm_rl.regimes.Physics>`.
    """
    import mujoco
    from dm_control.suite import common

    value = dict(zip(Physics.names, row, strict=True))
    root = ElementTree.fromstring(common.read_model(f"{domain}.xml"))
    for element, attribute, index in EDITS[domain](root):
        numbers = [float(word) for word in element.get(attribute).split()]
        numbers[index] *= value["length"]
        element.set(attribute, " ".join(repr(number) for number in numbers))
    with quiet():
        text = ElementTree.tostring(root, encoding="unicode")
        changed = mujoco.MjModel.from_xml_string(text, dict(common.ASSETS))
    changed.opt.disableflags = model.opt.disableflags
    rest = tuple({**value, "length": 1.0}.values())
    return changed_model(changed, rest)


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


def actuator_inversion_task(
    task: str = "cartpole",
    contexts: int = 20,
    steps: int | None = None,
    reward: Reward | None = None,
    action_low: Limits = None,
    action_high: Limits = None,
) -> Task:
    """Return a task of the benchmark.

    Its families of regimes are the benchmark's splits, see :func:`contexts_of`; the seed of a
    mission selects its context.

    Args:
        task: ``cartpole``, ``reacher_easy``, ``reacher_hard``, ``cheetah``, ``ball_in_cup``, which
            need dm_control, or ``double_integrator``, ``double_integrator_friction``, ``ode``.
        contexts: of each split.
        steps: length of an episode; as published if None.
        reward: reward of the planner; that of the task if None.
        action_low: lowest action; the task's if None.
        action_high: highest action.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> task = actuator_inversion_task("double_integrator")
    >>> task.contexts["out_reversed"][0]
    ({'gain_0': 10.0, 'gain_1': 10.0}, {'gain_0': -10.0, 'gain_1': -10.0})
    """
    check_choice("robot.task", task, (*BODIES, *TOYS))
    check_count("robot.contexts", contexts)
    if task in TOYS:
        made = TOYS[task](contexts)
    else:
        domain, name, nominal, spans = BODIES[task]
        change = partial(stretched, domain) if domain in EDITS else changed_model
        made = dm_control_task(domain, name, change=change)
        bound_noise(cast(KnownDynamics, made.world), made.start(0)[0], made.low, made.high)
        signs = SIGNS if domain in EDITS else SIGNS[:1]
        regime = partial(body_regime, len(made.low), **nominal)
        made = replace(made, contexts=contexts_of(spans, regime, signs, contexts))
    return replace(
        made,
        plan=made.plan if reward is None else reward,
        low=action_low or made.low,
        high=action_high or made.high,
        steps=made.steps if steps is None else check_count("robot.steps", steps),
    )
