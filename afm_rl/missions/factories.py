"""Makers of the parts that a method is composed of, for the configuration groups.

Each takes the robot first, a corrector also the model, and its own settings by name, and returns a
module. One that needs training comes as a :class:`Part` with its :class:`Training`, so that all is
built and checked before anything is trained.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from torch import nn

from afm_rl.correction import (
    ActionFlow,
    L1Augmentation,
    LeastSquares,
    PaperFlow,
)
from afm_rl.correction.training import train_flow
from afm_rl.dynamics import (
    KNODE,
    Calibrated,
    DynamicsModel,
    Ensemble,
    Oracle,
    Quadrotor,
    UnknownDynamics,
)
from afm_rl.errors import AFMError, ConfigurationError, check_count, check_instance
from afm_rl.learning import pretrain_ensemble, pretrain_knode
from afm_rl.missions.collected import fit_collected
from afm_rl.missions.robot import Robot
from afm_rl.options import Natural, options
from afm_rl.planning.costs import KnownReward
from afm_rl.storage.artefacts import load_artefact
from afm_rl.transforms.loop_options import LoopOptions

Checkpoint = Annotated[str | None, "file with weights of your corrector; None: none"]
Contexts = Annotated[
    Sequence[Natural] | None,
    "state coordinates on which the fault may depend; None: those of the robot",
]


class Training(NamedTuple):
    """How a part is trained, if it is not taken from the cache."""

    title: str
    """What is trained, for people."""
    module: nn.Module
    """Trained in place."""
    train: Callable[[bool], float | Mapping[str, Any]]
    """Trains with or without a progress bar; returns the held-out error, or, by name, a
    :class:`~afm_rl.learning.FitReport` and the ``rewards`` of rounds of data."""
    unit: str
    """Unit of the held-out error."""
    settings: Sequence[Mapping[str, Any]] = ()
    """Everything that the result depends on, beside the robot."""


class Part(NamedTuple):
    """A module, and its training if it needs one."""

    module: Any
    training: Training | None = None
    settings: Mapping[str, Any] | None = None
    """What its predictions before the missions depend on; None: on the nominal physics alone."""


def as_part(group: str, made: Any, kind: type) -> Part:
    """Return what a maker gave as a part: a bare module needs no training."""
    if isinstance(made, Part):
        return made
    return Part(check_instance(f"{group}: its maker", made, kind))


def physics(robot: Robot) -> DynamicsModel:
    """Return the robot's nominal physics, if there are any."""
    if isinstance(robot.model, UnknownDynamics):
        robot.model(torch.zeros(0), torch.zeros(0))  # says what to do
    return robot.model


def oracle(robot: Robot, base: Callable[[Robot], Part | DynamicsModel]) -> Part:
    """Return another model, which ``base`` makes, seen through the true regime."""
    part = as_part("dynamics.base", base(robot), DynamicsModel)
    settings = {"model": "oracle", **(part.settings or {})}
    return part._replace(module=Oracle(part.module, robot.regime), settings=settings)


def calibrated(robot: Robot, base: Callable[[Robot], Part | DynamicsModel]) -> Part:
    """Return another model, which ``base`` makes, frozen, with a calibration per mission."""
    part = as_part("dynamics.base", base(robot), DynamicsModel)
    low, high = robot.usual_bounds
    return part._replace(module=Calibrated(part.module, (high - low) / 2))


@options("dynamics", Ensemble, pretrain=pretrain_ensemble)
def ensemble(robot: Robot, pretrain: Mapping[str, Any], **settings: Any) -> Part:
    """Return an ensemble to be pre-trained on the nominal physics, or on what a robot collects."""
    nominal = robot.model
    least = pretrain.get("batch_size", 1)
    check_count("dynamics.pretrain.samples", pretrain.get("samples", least), low=least)
    model = Ensemble(nominal.manifold, nominal.action_size, list(robot.features), **settings)
    own = _without(settings, "propagation", "precision")
    unit = "standard deviations of the data"
    if robot.data is not None:
        fit = partial(fit_collected, model, robot, robot.data)
        return Part(model, Training("ensemble", model, fit, unit, [own]), own)

    def train(progress: bool) -> Mapping[str, Any]:
        bounds = robot.state_bounds, robot.action_bounds
        names = robot.state_names if model.manifold.tangent_size == model.state_size else None
        given = {"names": names, "progress": progress, **pretrain}
        return asdict(pretrain_ensemble(model, nominal, *bounds, **given))

    shape = {"pretrain": dict(pretrain), **own}
    return Part(model, Training("ensemble", model, train, unit, [shape]), shape)


@options("dynamics", KNODE, pretrain=pretrain_knode)
def knode(
    robot: Robot,
    pretrain: Mapping[str, Any] | None = None,
    randomised: Annotated[bool, "pre-train on flights under regimes of the prior"] = False,
    **settings: Any,
) -> Part:
    """Return a quadrotor's physics plus networks; ``pretrain`` says how the first one is trained.

    Further ``settings`` are those of :class:`~afm_rl.dynamics.KNODE`.
    """
    nominal = robot.model
    if not isinstance(nominal, Quadrotor):
        raise ConfigurationError(
            f"dynamics=knode: robot={robot.name}: the rate of change of {type(nominal).__name__} "
            "is not known; choose robot=quadrotor, or dynamics=pe"
        )
    model = KNODE(nominal, **settings)
    if pretrain is None:
        return Part(model)

    def train(progress: bool) -> float:
        (low, high), (least, most) = robot.action_bounds, robot.usual_bounds
        actions = torch.maximum(low, least), torch.minimum(high, most)
        regime = robot.regime if randomised else None
        bounds = robot.state_bounds, actions
        return pretrain_knode(model, nominal, *bounds, regime=regime, progress=progress, **pretrain)

    shape = {"pretrain": dict(pretrain), "randomised": randomised, **settings}
    unit = "standard deviations of the model"
    return Part(model, Training("KNODE", model, train, unit, [shape]), shape)


def reward(robot: Robot) -> KnownReward:
    """Return the cost that is the negative reward of the robot's task."""
    return robot.known_reward()


@options("corrector", LoopOptions)
def no_correction(robot: Robot, dynamics: Part, **settings: Any) -> Part:
    """Return nothing: the planned action is executed as it is."""
    return Part(None)


@options("corrector", ActionFlow, LoopOptions)
def afm(
    robot: Robot,
    dynamics: Part,
    context_coordinates: Contexts = None,
    **settings: Any,
) -> ActionFlow:
    """Return action flow matching, which needs no training."""
    coordinates = robot.context_coordinates if context_coordinates is None else context_coordinates
    return ActionFlow(*robot.action_bounds, context_coordinates=list(coordinates), **settings)


@options("corrector", PaperFlow, LoopOptions, train=train_flow)
def paper_flow(
    robot: Robot,
    dynamics: Part,
    train: Mapping[str, Any],
    checkpoint: Checkpoint = None,
    clamp: Annotated[bool, "limit actions to the action bounds; the published runs did not"] = True,
    **settings: Any,
) -> Part:
    """Return the published flow, to be trained over the model.

    States are subtracted number by number, as published, rotations too. Without ``clamp`` the
    environment takes actions of up to ten times the robot's bounds.
    """
    model = dynamics.module
    if settings.get("wrap") and model.manifold.tangent_size != model.state_size:
        raise ConfigurationError(
            f"corrector.wrap=true: robot={robot.name} has states with rotations, which "
            "corrector=paper does not wrap; choose corrector.wrap=false, or corrector=afm"
        )
    size, features = model.state_size, list(robot.features)
    flow = PaperFlow(*robot.action_bounds, features=features, state_size=size, **settings)
    if checkpoint is not None:
        _load(flow, checkpoint)
        return Part(flow)
    if dynamics.settings is None:
        model = robot.model

    def fit(progress: bool) -> float:
        return train_flow(flow, model, robot.state_bounds, progress=progress, **train)

    own = _without(settings, "rule", "gate", "steps", "error_action", "latch")
    shape = [dynamics.settings or {}, {**own, "train": train}]
    return Part(flow, Training("flow", flow, fit, "action units", shape))


@options("corrector", LeastSquares, LoopOptions)
def least_squares(robot: Robot, dynamics: Part, **settings: Any) -> LeastSquares:
    """Return least squares with forgetting, which need no training."""
    return LeastSquares(*robot.action_bounds, **settings)


@options("corrector", L1Augmentation, LoopOptions)
def l1(robot: Robot, dynamics: Part, dt: float | None = None, **settings: Any) -> L1Augmentation:
    """Return L1 adaptive augmentation, which needs no training."""
    step: Any = robot.dt if dt is None else dt  # None is refused, by name
    return L1Augmentation(*robot.action_bounds, dt=step, **settings)


def _load(flow: PaperFlow, checkpoint: str) -> None:
    """Load the weights of a flow, in place."""
    if not isinstance(checkpoint, str):
        raise ConfigurationError(
            f"corrector.checkpoint={checkpoint!r}: expected the path of a file"
        )
    try:
        load_artefact(Path(checkpoint), flow, flow.signature)
    except AFMError as error:
        raise ConfigurationError(f"corrector.checkpoint: {error}") from error


def _without(settings: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """Leave out the settings that have no influence on what is trained."""
    return {name: value for name, value in settings.items() if name not in names}
