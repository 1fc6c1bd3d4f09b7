"""From a configuration to a robot, its agent and its missions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Compose, EnvBase, TransformedEnv

from afm_rl.dynamics import Calibrated, DynamicsModel, Oracle
from afm_rl.errors import ConfigurationError, check_choice, check_count
from afm_rl.learning import GaussianNLLLoss, MassEstimator, OracleUpdater, RLSUpdater, Updater
from afm_rl.missions.checks import blaming, check_cost, check_keys
from afm_rl.missions.factories import Training
from afm_rl.missions.robot import Robot
from afm_rl.missions.selection import (
    build_missions,
    fit_schedule,
    name_regimes,
    select_regimes,
    select_seeds,
    select_tracks,
)
from afm_rl.planning import MPC, GeometricController, PlanningEnv
from afm_rl.targets import check_targets
from afm_rl.transforms import ActionFlowTransform, Guard

ROBOT_SHAPES = (
    *("action_low", "action_high", "state_low", "state_high"),
    *("features", "model", "regime", "flow_low", "flow_high"),
)
NOMINAL = {"_target_": "afm_rl.missions.factories.physics", "_partial_": True}
AFTER_TRAINING = (
    *("gate", "samples", "steps", "error_action", "wrap", "latch", "checkpoint"),
    *("propagation", "precision"),
    *("memory", "views", "forgetting", "choose", "enabled", "extend_action_box"),
)


@dataclass
class Agent:
    """Everything that runs the missions of one method.

    Planner, transform and updater share :attr:`model`.
    """

    label: str
    robot: Robot
    env: TransformedEnv
    missions: TensorDictBase
    regime_names: list[str]
    """The regime of each mission, in words."""
    model: DynamicsModel
    planner: TensorDictModuleBase
    updater: Updater
    transform: ActionFlowTransform | None
    executed_key: NestedKey
    trainings: Sequence[Training]
    faults: str
    """What a mission does at a fault: ``hold``, ``skip`` or ``raise``."""
    settings: Mapping[str, Any]
    """The resolved configuration."""

    @property
    def base_env(self) -> EnvBase:
        """The robot's environment without transforms."""
        return self.env.base_env


def build(cfg: DictConfig, trust: Sequence[str] = ()) -> Agent:
    """Compose an agent and check every setting; nothing is trained yet.

    Args:
        cfg: a configuration composed from ``afm_rl.conf``.
        trust: packages whose code it may name, beside the parts of this library.

    Raises:
        ConfigurationError: for settings that cannot be used, naming the key.
    """
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    check_targets(settings, trust)
    label = cfg.label
    if label is not None and not isinstance(label, str):
        raise ConfigurationError(f"label={label!r}: expected a text")
    with blaming("robot"):
        robot: Robot = instantiate(settings["robot"], _convert_="all")
        tracks = select_tracks(settings["tracks"], robot)
        regimes = select_regimes(settings["regimes"], robot)
    seeds = select_seeds(settings["seeds"])
    budget = check_count("budget", settings["budget"])
    faults = check_choice("faults", settings["faults"], ("hold", "skip", "raise"))
    with blaming("robot.env"):
        env = robot.env(
            tracks=tracks,
            regime=robot.regime,
            schedule=fit_schedule(robot.schedule, regimes),
            max_steps=budget,
            action_low=robot.action_low,
            action_high=robot.action_high,
        )
    robot.metrics.check(env, robot.goal_names)
    missions = build_missions(env, tracks, regimes, seeds)

    def make(group: str, *args: Any) -> Any:
        with blaming(group):
            return instantiate(settings[group], _convert_="all")(*args)

    dynamics = make("dynamics", robot)
    corrector = make("corrector", robot, dynamics)
    shapes = [_shaping(settings, group) for group in ("robot", "dynamics", "corrector")]
    if dynamics.nominal:  # all such flows are one and the same
        shapes[1] = NOMINAL
    trainings = [
        part.training._replace(settings=shaping)
        for part, shaping in ((dynamics, shapes[:2]), (corrector, shapes))
        if part.training is not None
    ]
    model, transform = dynamics.module, corrector.module
    with blaming("cost"):
        cost = instantiate(settings["cost"], _convert_="all")
    planner = make("planner", PlanningEnv(model, cost, *robot.action_box))
    guard = Guard()
    executed_key = ("next", guard.key("executed_action"))
    loss = GaussianNLLLoss(model)
    loss.set_keys(action=executed_key)
    updater = make("updater", loss)
    if isinstance(model, Oracle) != isinstance(updater, (OracleUpdater, MassEstimator)):
        raise ConfigurationError(
            "dynamics=oracle and an updater that tells it the regime belong together: choose "
            "both, dynamics=oracle with updater=oracle or updater=mass, or neither"
        )
    if isinstance(model, Calibrated) and updater.learns and not isinstance(updater, RLSUpdater):
        raise ConfigurationError(
            f"dynamics: a calibrated model stays as it is but for its calibration, and "
            f"{type(updater).__name__} does not teach that; choose updater=rls or updater=frozen"
        )
    chain = [guard] if transform is None else [guard, transform]
    if hasattr(planner, "make_tensordict_primer"):
        chain.append(planner.make_tensordict_primer())
    whole = TransformedEnv(env, Compose(*chain))
    stages = planner.horizon + 1 if isinstance(planner, (MPC, GeometricController)) else None
    check_cost(cost, model, whole, stages)
    check_keys("planner", planner, whole)
    check_keys("updater", updater, whole)
    return Agent(
        label=label or "unnamed",
        robot=robot,
        env=whole,
        missions=missions,
        regime_names=name_regimes(tracks, regimes, seeds, robot),
        model=model,
        planner=planner,
        updater=updater,
        transform=transform,
        executed_key=executed_key,
        trainings=trainings,
        faults=faults,
        settings=settings,
    )


def _shaping(settings: Mapping[str, Any], group: str) -> dict[str, Any]:
    """Return those settings of a group that shape a trained part, for its place in the cache."""
    if group == "robot":
        return {name: settings[group][name] for name in ROBOT_SHAPES if name in settings[group]}
    chosen = settings[group]
    chosen = chosen.get("base", chosen)  # what is calibrated is trained before its calibration
    return {name: value for name, value in chosen.items() if name not in AFTER_TRAINING}
