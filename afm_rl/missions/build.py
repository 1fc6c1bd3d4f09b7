"""From a configuration to a robot, its agent and its missions; and the agent's training."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Compose, EnvBase, TransformedEnv

from afm_rl._version import __version__
from afm_rl.compiling.devices import check_device
from afm_rl.correction import Corrector
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_choice, check_count, refusing
from afm_rl.learning import GaussianNLLLoss, Updater
from afm_rl.missions.checks import (
    check_cost,
    check_keys,
    check_label,
    check_models,
    check_updater,
)
from afm_rl.missions.factories import Part, Training, as_part
from afm_rl.missions.robot import SHAPE_TRAINING, Robot
from afm_rl.missions.selection import (
    build_missions,
    fit_schedule,
    name_method,
    select_regimes,
    select_seeds,
    select_tracks,
)
from afm_rl.planning import Cost, PlanningEnv
from afm_rl.storage.artefacts import cached, load_artefact, read_tensors
from afm_rl.transforms import ActionFlowTransform, Guard
from afm_rl.transforms.loop_options import LoopOptions
from afm_rl.trust import check_targets, check_trust, instantiate, trusting

GROUPS = ("robot", "cost", "planner", "dynamics", "updater", "corrector")
UNCLAMPED = 10.0
"""Bounds of an environment whose corrector does not clamp, in bounds of the robot."""
DEFAULTS = {"seeds": 1, "budget": 5000, "label": None, "faults": "hold", "device": "cpu"}
"""Settings that a configuration may leave out."""
TRAINED = Path(__file__).parent / "trained"
"""Parts that come with the library, so that the first command need not train them."""


@dataclass
class Agent:
    """All parts that run the missions of one method.

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

    def to(self, device: torch.device) -> Agent:
        """Move everything to a device, in place.

        Raises:
            ConfigurationError: for ``mps``, which has no double precision, if a part needs it.
        """
        parts = (self.robot.model, self.model, self.env, self.planner, self.updater)
        if device.type == "mps":
            tensors = chain(*(chain(part.parameters(), part.buffers()) for part in parts))
            double = any(tensor.dtype is torch.float64 for tensor in tensors)
            if double or self.transform is not None or self.updater.sets == "calibration":
                raise ConfigurationError(
                    "device=mps: it has no double precision, which corrections, calibrations "
                    "and tracking need; choose device=cpu, or a method without them"
                )
        self.missions = self.missions.to(device)
        for part in parts:
            part.to(device)
        return self

    @property
    def device(self) -> torch.device:
        """The device of its tensors."""
        return self.missions.device or torch.device("cpu")

    @property
    def base_env(self) -> EnvBase:
        """The robot's environment without transforms."""
        return self.env.base_env


def build(cfg: DictConfig, trust: Sequence[str] = ()) -> Agent:
    """Build an agent and check every setting, without training.

    Args:
        cfg: a configuration composed from ``afm_rl.conf``, or your own with the groups
            ``robot``, ``cost``, ``planner``, ``dynamics``, ``updater`` and ``corrector``, and
            ``tracks`` and ``regimes``.
        trust: packages whose code it may name, in addition to this library.

    Raises:
        ConfigurationError: for invalid settings, naming the key.
    """
    with trusting(check_trust(list(trust))):
        return _build(cast(dict, OmegaConf.to_container(cfg, resolve=True)))


def _build(settings: dict[str, Any]) -> Agent:
    settings = {**DEFAULTS, **settings}
    _check(settings)
    device = check_device("device", settings["device"])
    task = _build_robot(settings)
    dynamics = _build_dynamics(settings, task.robot)
    corrector, transform = _build_corrector(settings, task.robot, dynamics)
    planner, cost = _build_planner(settings, task.robot, dynamics.module, transform)
    guard = Guard()
    executed_key = ("next", task.robot.reported or guard.key("executed_action"))
    updater = _build_updater(settings, task.robot, dynamics.module, executed_key)
    chain = [guard] if transform is None else [guard, transform]
    if hasattr(planner, "make_tensordict_primer"):
        chain.append(planner.make_tensordict_primer())
    env = TransformedEnv(task.env, Compose(*chain))
    check_cost(cost, env, getattr(planner, "stages", None))
    check_keys("planner", planner, env)
    check_keys("updater", updater, env)
    agent = Agent(
        label=settings["label"] or name_method(settings),
        robot=task.robot,
        env=env,
        missions=task.missions,
        regime_names=task.regime_names,
        model=dynamics.module,
        planner=planner,
        updater=updater,
        transform=transform,
        executed_key=executed_key,
        trainings=_trainings(settings, [dynamics, corrector], planner),
        faults=settings["faults"],
        settings=settings,
    )
    return agent.to(device)


def _check(settings: Mapping[str, Any]) -> None:
    """Check what can be checked before anything is built."""
    for group in GROUPS:
        if not isinstance(settings.get(group), Mapping):
            raise ConfigurationError(
                f"{group}={settings.get(group)!r:.80}: expected settings; build needs those of "
                f"{', '.join(GROUPS)}"
            )
    check_targets(settings)
    check_models(settings)
    check_label(settings["label"])
    check_choice("faults", settings["faults"], ("hold", "skip", "raise"))


def _make(settings: Mapping[str, Any], group: str, *args: Any, **changed: Any) -> Any:
    """Make the part that a group of settings describes."""
    with refusing(group):
        return instantiate(group, {**settings[group], **changed})(*args)


class _Task(NamedTuple):
    """A robot, and what it is to do."""

    robot: Robot
    env: EnvBase
    missions: TensorDictBase
    regime_names: list[str]


def _clamps(settings: Mapping[str, Any]) -> bool:
    """Return whether the corrector keeps to the action bounds."""
    return settings["corrector"].get("clamp", True)


def _build_robot(settings: Mapping[str, Any]) -> _Task:
    """Build the robot, its environment and its missions: tracks x regimes x seeds."""
    with refusing("robot"):
        robot: Robot = instantiate("robot", settings["robot"])
        tracks = select_tracks(settings.get("tracks"), robot)
        regimes = select_regimes(settings.get("regimes"), robot)
    seeds = select_seeds(settings["seeds"])
    budget = check_count("budget", settings["budget"], high=10_000_000)
    total = len(tracks) * len(regimes) * len(seeds)
    check_count("seeds: missions, for all tracks and regimes", total, high=1_000_000)
    reach = 1.0 if _clamps(settings) else UNCLAMPED
    with refusing("robot.env"):
        env = robot.env(
            tracks=tracks,
            regime=robot.regime,
            schedule=fit_schedule(robot.schedule, regimes),
            max_steps=budget,
            action_low=[reach * end for end in robot.action_low],
            action_high=[reach * end for end in robot.action_high],
        )
    if robot.reported is not None:
        check_choice("robot.reported", robot.reported, env.full_observation_spec.keys())
    robot.metrics.check(env, robot.goal_names)
    missions, regime_names = build_missions(env, tracks, regimes, seeds)
    return _Task(robot, env, missions, regime_names)


def _build_dynamics(settings: Mapping[str, Any], robot: Robot) -> Part:
    """Build the model that planner, transform and updater share."""
    return as_part("dynamics", _make(settings, "dynamics", robot), DynamicsModel)


def _build_corrector(
    settings: Mapping[str, Any], robot: Robot, dynamics: Part
) -> tuple[Part, ActionFlowTransform | None]:
    """Build the corrector and the transform around it; None if nothing is corrected.

    Settings of the loop are those of the transform, whatever corrector is chosen.
    """
    own = dict(settings["corrector"])
    ours = LoopOptions.__annotations__.keys() - {"delay", "delay_compensation"}
    around: Any = {name: own.pop(name) for name in [*own] if name in ours}
    with refusing("corrector"):
        made = instantiate("corrector", own)(robot, dynamics)
        corrector = as_part("corrector", made, Corrector)
        if corrector.module is None:
            return corrector, None
        # Scores and updaters read what was measured; planners the state in which they will act.
        around |= dict(reported_key=robot.reported, delay_compensation=False)
        return corrector, ActionFlowTransform(dynamics.module, corrector.module, **around)


def _build_planner(
    settings: Mapping[str, Any],
    robot: Robot,
    model: DynamicsModel,
    transform: ActionFlowTransform | None,
) -> tuple[TensorDictModuleBase, Cost]:
    """Build the planner, and the cost that it minimises in the planning environment."""
    with refusing("cost"):
        cost = instantiate("cost", settings["cost"])
        cost = cost if isinstance(cost, Cost) else cost(robot)
    seen = "observation" if transform is None else transform.key("arrival")
    world = PlanningEnv(
        model, cost, *robot.action_bounds, observation_key=seen, observe=robot.observe
    )
    # Without a transform the planner does not know which effects are achievable.
    unknown = transform is None or not _clamps(settings)
    changed = {"bounds_key": None} if unknown and "bounds_key" in settings["planner"] else {}
    return _make(settings, "planner", world, **changed), cost


def _build_updater(
    settings: Mapping[str, Any], robot: Robot, model: DynamicsModel, executed_key: NestedKey
) -> Updater:
    """Build the updater, which learns from executed actions."""
    loss = GaussianNLLLoss(model)
    loss.set_keys(action=executed_key)
    changed = {}
    if settings["updater"].get("scale", 0) is None:
        low, high = robot.usual_bounds
        changed = {"scale": ((high - low) / 2).tolist()}
    updater = _make(settings, "updater", loss, **changed)
    check_updater(updater, model)
    return updater


def _trainings(
    settings: Mapping[str, Any], parts: Sequence[Part], planner: TensorDictModuleBase
) -> list[Training]:
    """Return how parts are trained, each with all that its result depends on."""
    shape = {name: value for name, value in settings["robot"].items() if name in SHAPE_TRAINING}
    # The name of a policy's file does not tell what it holds.
    signature = [planner.signature] if hasattr(planner, "signature") else []
    return [
        part.training._replace(settings=[shape, *part.training.settings, *signature])
        for part in parts
        if part.training is not None
    ]


def prepare(
    agent: Agent, cache: str | Path, progress: bool = False, echo: Callable[[str], None] = print
) -> dict[str, float]:
    """Train parts that are not in the cache or in :data:`TRAINED`; return their errors.

    Args:
        agent: its parts are trained in place.
        cache: folder of trained parts.
        progress: show progress bars.
        echo: receives one line per part.

    Returns:
        Held-out errors of the trained parts.

    Raises:
        ConfigurationError: if the cache cannot be written; before anything is trained.
        ArtefactError: if a part in the cache is damaged.
    """
    folder = Path(cache).expanduser()
    errors = {}
    for part in agent.trainings:
        description = {"name": part.title, "version": __version__, "settings": part.settings}
        description.update(getattr(part.module, "signature", {}))
        start = time.perf_counter()
        own = _as_it_comes(part, description)
        report, hit = cached(folder, part.module, description, own or partial(part.train, progress))
        trained = "as it comes" if own else f"trained in {time.perf_counter() - start:.0f} s"
        spent = "from the cache" if hit else trained
        report = report if isinstance(report, Mapping) else {"error": report}
        errors[part.title] = float(report["error"])
        echo(f"{part.title}: held-out error {report['error']:.4f} {part.unit} ({spent})")
        if "rms" in report:
            pairs = zip(report["names"], report["rms"], strict=True)
            each = ", ".join(f"{name} {error:.2g}" for name, error in pairs)
            echo(f"{part.title}: root mean square error of a step: {each}")
        if "rewards" in report:
            rewards = ", ".join(f"{reward:.3g}" for reward in report["rewards"])
            echo(f"{part.title}: reward per step of each round of data, random first: {rewards}")
    return errors


def _as_it_comes(part: Training, description: Mapping[str, Any]) -> Callable[[], Any] | None:
    """Return what loads a part that comes with the library; None if it is another one."""
    path = TRAINED / f"{part.title}.safetensors"
    wanted = json.loads(json.dumps(description))
    if not path.is_file() or not wanted.items() <= read_tensors(path)[1].items():
        return None
    return lambda: load_artefact(path, part.module, description)["held_out_error"]
