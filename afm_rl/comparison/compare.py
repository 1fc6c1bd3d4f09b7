"""One call that says whether a correction helps a robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from afm_rl.comparison.episodes import Method, Played, play, read_methods, window_of
from afm_rl.comparison.policy import Policy, name_of, read_policy
from afm_rl.comparison.result import Comparison
from afm_rl.comparison.robot import Robot, read_robot
from afm_rl.correction import Corrector
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_choice, check_count
from afm_rl.progress import Bar
from afm_rl.regimes.presets import Actuators, Fault, presets, servo_faults
from afm_rl.transforms.check_model import check_model

FAULTS = (
    *("none", "one reversed", "all reversed", "swapped pair", "half", "dead"),
    *("bias .3", "late 2", "lag 2"),
)
"""Names of the faults that are played if none are given, as far as a robot has them."""
HEALTHY = 0.2  # share of an episode before the fault
TRIAL = 10  # steps that a healthy robot must act at least


def compare(
    env: Any,
    policy: Any = None,
    faults: Sequence[str] | Mapping[str, Fault] | None = None,
    methods: Sequence[Method] | Mapping[str, Method] = ("none", "AFM"),
    episodes: int = 3,
    steps: int | None = None,
    at: int | None = None,
    model: DynamicsModel | Callable[..., torch.Tensor] | str = "mujoco",
    residual_steps: int = 0,
    seed: int = 0,
    progress: bool = True,
    **options: Any,
) -> Comparison:
    """Let a policy act under faults of the actuators, without a correction and with others.

    It begins with :func:`~afm_rl.check_model`, whose verdict is printed. Then, for each method, the
    episodes of all faults run as one batch. Methods meet the same faults and seeds, so that
    differences are those of pairs.

    Args:
        env: id of a gymnasium environment; an environment of gymnasium, TorchRL or dm_control; or a
            function that makes one. An environment with a specification is made again by it, so
            give a function if you have changed yours.
        policy: a function of one observation without a memory; a module of TorchRL, or of torch for
            a batch of observations; a model of Stable-Baselines3; a file: a model of
            Stable-Baselines3 (zip), ONNX, or one of ``save_policy``; None: random actions.
        faults: names of :func:`~afm_rl.regimes.presets`, or parameters of
            :class:`~afm_rl.FaultWrapper` by a name of your own; None: :data:`FAULTS`. The healthy
            robot, ``"none"``, is always the first.
        methods: ``"none"``, ``"AFM"``, ``"least squares"``, ``"oracle"``, which is given the fault,
            or any :class:`~afm_rl.correction.Corrector`; or these by a name of your own.
        episodes: of each fault and method, with seeds from ``seed`` on.
        steps: of an episode, at most; None: as many as the environment has, or 1000.
        at: steps of an episode before the fault; None: a fifth of it.
        model: of the healthy robot, as :class:`~afm_rl.ActionFlowWrapper` takes it.
        residual_steps: as there; if it is more than ``at``, a fault is seen before the fit.
        seed: of the first episode.
        progress: show a bar.
        options: other arguments of :class:`~afm_rl.ActionFlowWrapper`, such as ``state``,
            ``observe`` and ``action_map``.

    Returns:
        The :class:`Comparison`, which prints itself as a table.

    Raises:
        ConfigurationError: before anything runs, for an unknown id, fault or method; an environment
            that cannot be made again; a policy of another size; a model that does not fit; or a
            healthy robot whose episodes end before the fault.
        ArtefactError: for a file that holds no policy.

    >>> import numpy as np
    >>> def act(observation):  # of Pendulum-v1: cosine, sine and speed of an angle
    ...     return [-2.0 * observation[2]]
    >>> def step(state, action):
    ...     angle, speed = state.split(1, -1)
    ...     speed = (speed + 0.05 * (15 * angle.sin() + 3 * action)).clamp(-8, 8)
    ...     return torch.cat([angle + 0.05 * speed, speed], -1)
    >>> def state(env, observation):
    ...     return env.unwrapped.state
    >>> def observe(states):
    ...     angle, speed = states.T
    ...     return np.stack([np.cos(angle), np.sin(angle), speed], -1)
    >>> settings = {"model": step, "state": state, "observe": observe}
    >>> settings |= {"episodes": 1, "steps": 30, "progress": False}
    >>> found = compare("Pendulum-v1", act, ["late 2"], **settings)
    The model is right: it predicts 100 % of the motion (state[0] 100 %, state[1] 100 %; 300 steps).
    >>> found.table["fault"].tolist()
    ['none', 'none', 'late 2', 'late 2']
    """
    check_count("compare: episodes", episodes)
    check_count("compare: seed", seed, low=0)
    chosen = read_methods(methods)
    robot = read_robot(env, model=model, residual_steps=residual_steps, **options)
    kinds = read_faults(faults, robot)
    steps, at = _durations(robot, steps, at)
    for name, method in chosen.items():
        if isinstance(method, Corrector) and method.action_size != robot.sizes[1]:
            raise ConfigurationError(
                f"compare: method {name}: a corrector of {method.action_size} actions, but "
                f"{robot.name} has {robot.sizes[1]}"
            )
    acting = read_policy(policy, robot)
    seeds = [*range(seed, seed + episodes)]
    _check_healthy(robot, acting, seeds, at, policy is None)
    verdict = _verdict(robot, seed) if len(chosen) > 1 else ""
    names = [name for name in kinds for _ in seeds]
    played: dict[str, Played] = {}
    with Bar(total=steps * len(chosen), main=True, shown=progress) as bar:
        for name, method in chosen.items():
            bar.set_description_str(name, refresh=False)
            rows = [kinds[fault] for fault in names]
            played[name] = play(
                robot, acting, method, rows, seeds * len(kinds), at, steps, bar, names
            )
    title = f"{robot.name}, {name_of(policy)}"
    window = window_of(robot, steps - at)
    return Comparison(title, [*kinds], seeds, at, played, verdict, window)


def read_faults(
    faults: Sequence[str] | Mapping[str, Fault] | None, robot: Robot
) -> dict[str, Fault]:
    """Return faults by name, the healthy robot first.

    Raises:
        ConfigurationError: for an unknown name, or parameters that a fault cannot have.
    """
    space: Any = robot.first.action_space
    known = presets(len(space.low)) if robot.home is None else servo_faults(len(space.low))
    if faults is None:
        found: dict[str, Fault] = {}
        for name in FAULTS:  # of one actuator, all are one
            if name in known and known[name] not in found.values():
                found[name] = known[name]
    elif isinstance(faults, Mapping):
        found = {**faults}
    else:
        faults = [faults] if isinstance(faults, str) else faults
        found = {name: known[check_choice("compare: fault", name, known)] for name in faults}
    low, high = space.low.tolist(), space.high.tolist()
    Actuators(low, high, [len(found)], robot.home).fail(*found.values())  # checks parameters
    return {"none": {}, **found}


def _durations(robot: Robot, steps: int | None, at: int | None) -> tuple[int, int]:
    """Return how many steps an episode has, and how many come before the fault."""
    steps = robot.limit if steps is None else check_count("compare: steps", steps, low=2)
    steps = min(steps, robot.limit)
    at = round(HEALTHY * steps) if at is None else check_count("compare: at", at, low=0)
    if at >= steps:
        raise ConfigurationError(
            f"compare: at={at}: the fault begins after an episode of {steps} steps; give at= below "
            "that, or more steps="
        )
    return steps, at


def _verdict(robot: Robot, seed: int) -> str:
    """Print what a check of the model says; return it if the model is wrong."""
    state, action_map = robot.settings.get("state"), robot.settings.get("action_map")
    model = robot.settings["model"]
    found = check_model(robot.make(), model, state=state, seed=seed, action_map=action_map)
    said = " ".join(str(found).split())
    print(said)
    return "" if found.right else said


def _check_healthy(
    robot: Robot, policy: Policy, seeds: Sequence[int], at: int, random: bool
) -> None:
    """Refuse a robot that does not live to see a fault."""
    steps = max(at + 1, TRIAL)
    played = play(robot, policy, "none", [{}] * len(seeds), seeds, steps, steps)
    if (played.lasted == steps).any():
        return
    returns = played.rewards.sum(0).mean()
    advice = "give a policy (policy=None acts at random)" if random else "give a policy of it"
    raise ConfigurationError(
        f"compare: {robot.name}: the healthy robot ends its episodes after "
        f"{played.lasted.mean():.0f} steps, with a return of {returns:.4g}, before the fault at "
        f"step {at}; {advice}, or a smaller at="
    )
