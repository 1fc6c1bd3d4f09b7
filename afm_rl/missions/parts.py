"""Makers of the parts that a method is composed of, for the configuration groups.

Each takes the robot first and its own settings by name. A part that needs training carries
it as a :class:`Training`, so that everything is built and checked before anything is trained.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torch import nn

from afm_rl.artefacts import load_artefact
from afm_rl.dynamics import DynamicsModel, Ensemble, Oracle
from afm_rl.errors import AFMError, ConfigurationError
from afm_rl.flow import ContextFlow, Corrector, Flow, LeastSquares, PaperFlow, train_flow
from afm_rl.learning import pretrain_ensemble
from afm_rl.missions.checks import check_training
from afm_rl.missions.robot import Robot
from afm_rl.transforms import ActionFlowTransform


class Training(NamedTuple):
    """How a part is trained, if it is not taken from the cache."""

    title: str
    """What is trained, for people."""
    module: nn.Module
    """Trained in place."""
    train: Callable[[bool], float]
    """Trains with or without a progress bar; returns the held-out error."""
    unit: str
    """Unit of the held-out error."""
    settings: Sequence[Mapping[str, Any]] = ()
    """Everything that the result depends on."""


class Part(NamedTuple):
    """A module, and its training if it needs one."""

    module: Any
    training: Training | None = None


def physics(robot: Robot) -> Part:
    """Return the robot's nominal physics."""
    return Part(robot.model)


def oracle(robot: Robot) -> Part:
    """Return the nominal physics seen through the true regime."""
    return Part(Oracle(robot.model, robot.regime))


def ensemble(robot: Robot, pretrain: Mapping[str, Any], **settings: Any) -> Part:
    """Return an ensemble to be pre-trained on the nominal physics."""
    nominal = robot.model
    least = {"samples": pretrain.get("batch_size", 1)}
    check_training("dynamics.pretrain", pretrain_ensemble, pretrain, **least)
    model = Ensemble(nominal.manifold, nominal.action_size, list(robot.features), **settings)

    def train(progress: bool) -> float:
        boxes = robot.state_box, robot.action_box
        return pretrain_ensemble(model, nominal, *boxes, progress=progress, **pretrain)

    return Part(model, Training("ensemble", model, train, "standard deviations of the data"))


def no_flow(robot: Robot, model: DynamicsModel) -> Part:
    """Return nothing."""
    return Part(None)


def context_flow(
    robot: Robot,
    model: DynamicsModel,
    train: Mapping[str, Any],
    checkpoint: str | None = None,
    **settings: Any,
) -> Part:
    """Return the context flow, to be trained over ``model``."""
    flow = ContextFlow(*robot.flow_box, **settings)
    return _trained(flow, robot, model, train, checkpoint, "half ranges")


def paper_flow(
    robot: Robot,
    model: DynamicsModel,
    train: Mapping[str, Any],
    checkpoint: str | None = None,
    **settings: Any,
) -> Part:
    """Return the published flow, to be trained over ``model``.

    Raises:
        ConfigurationError: if states turn: the flow reads errors as differences of numbers.
    """
    if model.manifold.tangent_size != model.state_size:
        raise ConfigurationError(
            f"flow=paper: robot={robot.name} has states with rotations; choose flow=context"
        )
    flow = PaperFlow(
        *robot.flow_box, features=list(robot.features), state_size=model.state_size, **settings
    )
    return _trained(flow, robot, model, train, checkpoint, "action units")


def least_squares(robot: Robot, model: DynamicsModel, **settings: Any) -> Part:
    """Return least squares with forgetting, which needs no training."""
    return Part(LeastSquares(*robot.flow_box, **settings))


def _trained(
    flow: Flow,
    robot: Robot,
    model: DynamicsModel,
    settings: Mapping[str, Any],
    checkpoint: str | None,
    unit: str,
) -> Part:
    check_training("flow.train", train_flow, settings, batch_size=2)
    if checkpoint is not None:
        if not isinstance(checkpoint, str):
            raise ConfigurationError(f"flow.checkpoint={checkpoint!r}: expected the path of a file")
        try:
            load_artefact(Path(checkpoint), flow, flow.signature)
        except AFMError as error:
            raise ConfigurationError(f"flow.checkpoint: {error}") from error
        return Part(flow)

    def train(progress: bool) -> float:
        return train_flow(flow, model, robot.regime, robot.state_box, progress=progress, **settings)

    return Part(flow, Training("flow", flow, train, unit))


def no_transform(model: DynamicsModel, flow: Corrector | None) -> None:
    """Return nothing: the planned action is executed as it is."""
    if flow is not None:
        raise ConfigurationError("flow: nothing uses it; choose transform=afm, or flow=none")


def afm(model: DynamicsModel, flow: Corrector | None, **settings: Any) -> ActionFlowTransform:
    """Return the action flow transform."""
    if flow is None:
        raise ConfigurationError("transform=afm: needs a flow; choose flow=context or flow=paper")
    return ActionFlowTransform(model, flow, **settings)
