"""Faults of actuators around gymnasium's environments, by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper

from afm_rl.errors import ConfigurationError, check_choice, check_count, check_flag
from afm_rl.regimes.presets import Actuators, Fault, presets, servo_faults
from afm_rl.transforms.gymnasium import as_numbers, autoreset_mode_of

Faults = str | Fault | Sequence[str | Fault]


class FaultShell:
    """Actuators for N environments of gymnasium: what :class:`FaultWrapper` says."""

    env: Any

    def __init__(
        self, env: Any, fault: Faults = "none", at: int = 0, home: Any = None, clip: bool = True
    ) -> None:
        given: Any = {"fault": fault, "at": at, "home": home, "clip": check_flag("clip", clip)}
        RecordConstructorArgs.__init__(self, **given)  # type: ignore[arg-type]
        super().__init__(env)  # type: ignore[call-arg]
        space = getattr(env, "single_action_space", env.action_space)
        if not isinstance(space, Box) or len(space.shape) != 1 or space.dtype.kind != "f":
            raise ConfigurationError(
                f"FaultWrapper: action_space={space}: expected a Box of one vector of real numbers"
            )
        home = None if home is None else torch.as_tensor(home)
        self.presets = (presets if home is None else servo_faults)(space.shape[0])
        self.steps = np.zeros(getattr(env, "num_envs", 1), dtype=int)
        low, high = space.low.tolist(), space.high.tolist()
        self.actuators = Actuators(low, high, self.steps.shape, home)
        self.clip = clip
        self.fail(fault, at)

    def fail(self, fault: Faults, at: int = 0) -> None:
        """Have a fault from a step of each episode on, or from now on; ``"none"``: be healthy.

        Args:
            fault: a name of ``presets``, or the parameters of one; in a vector also one for each.
            at: how many steps of an episode come before.

        Raises:
            ConfigurationError: for an unknown name, or a value that it cannot have.
        """
        rows = [fault] if isinstance(fault, str | Mapping) else [*fault]
        self.at = check_count("FaultWrapper: at", at, low=0)
        self.faults = [self._parameters(row) for row in rows] * (len(self.steps) // len(rows))
        if len(self.faults) != len(self.steps):
            raise ConfigurationError(
                f"FaultWrapper: {len(rows)} faults: expected one, or {len(self.steps)}, one of each"
            )
        self.actuators.fail(*self.faults)
        self._wear()

    def _parameters(self, fault: str | Fault) -> Fault:
        if isinstance(fault, str):
            return self.presets[check_choice("FaultWrapper: fault", fault, self.presets)]
        return fault

    @property
    def failed(self) -> np.ndarray:
        """Do actuators have their faults by now? ``(N,)``."""
        return self.steps >= self.at

    def _wear(self) -> None:
        """Give the actuators the faults that they have by now."""
        rows = zip(self.faults, self.failed, strict=True)
        self.actuators.fail(*(fault if failed else {} for fault, failed in rows))

    def _begin(self, rows: Any = True) -> None:
        """Begin episodes with actuators that were not used yet, those in ``rows`` ``(N,)``."""
        self.steps[rows] = 0
        self.actuators.reset(torch.as_tensor(rows))
        self._wear()

    def _effects(self, actions: Any) -> np.ndarray:
        """Return what the actuators make of actions ``(N, A)``."""
        effects, space = self.actuators(actions).numpy(), self.env.action_space
        self.steps += 1
        if (self.steps == self.at).any():
            self._wear()
        if self.clip:
            effects = np.clip(effects, space.low, space.high)
        return effects.astype(space.dtype)


class FaultWrapper(FaultShell, gymnasium.Wrapper, RecordConstructorArgs):
    """Gives the actuators of a gymnasium environment a fault, to try what helps against it.

    Put it next to the environment, and :class:`~afm_rl.ActionFlowWrapper` around it: the correction
    does not know the fault. It is what :class:`~afm_rl.transforms.RegimeTransform` is in TorchRL.
    What reached the environment is the attribute ``effect`` ``(A,)``. :meth:`fail` changes the
    fault at any step.

    Args:
        env: with a vector of real numbers between finite bounds as action.
        fault: a name of :func:`~afm_rl.regimes.presets`, such as ``"one reversed"``, ``"half"`` or
            ``"late 2"``; or parameters of :func:`~afm_rl.regimes.actuator_regimes`, such as
            ``{"gain_1": -1.0}``, and ``rate``, ``random_delay`` and ``noise`` of
            :class:`~afm_rl.regimes.Actuators`.
        at: how many steps of each episode come before the fault.
        home: pose of position servos ``(A,)``, about which they have their faults, in the unit of
            the commands; names are then those of :func:`~afm_rl.regimes.servo_faults`.
        clip: bring effects into the action space, as actuators that cannot do more; False hands
            them on as they are, to environments that know what to do with them.

    Raises:
        ConfigurationError: for an action space, name or value that cannot be used.

    >>> env = FaultWrapper(gymnasium.make("Pendulum-v1"), "one reversed", at=1)
    >>> _ = env.reset(seed=0)
    >>> for _ in range(2):
    ...     _ = env.step(np.array([1.5], dtype=np.float32))
    ...     print(env.effect)
    [1.5]
    [-1.5]
    """

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin an episode with actuators that were not used yet."""
        self._begin()
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any):
        """Send the environment what the actuators make of the action."""
        action = as_numbers("action", action, self.env.action_space.shape)
        (self.effect,) = self._effects(action[None])
        return self.env.step(self.effect)


class FaultVectorWrapper(FaultShell, VectorWrapper, RecordConstructorArgs):
    """Gives the actuators of a vector of gymnasium environments faults, one of all or one of each.

    As :class:`FaultWrapper`, each environment with actuators of its own, which begin again where
    its episode does.

    >>> envs = gymnasium.make_vec("Pendulum-v1", num_envs=2, vectorization_mode="sync")
    >>> envs = FaultVectorWrapper(envs, ["none", {"gain_0": 0.5}])
    >>> _ = envs.reset(seed=0), envs.step(np.ones((2, 1), dtype=np.float32))
    >>> envs.effect.flatten()
    array([1. , 0.5], dtype=float32)
    """

    def __init__(self, env: VectorEnv, *args: Any, **settings: Any) -> None:
        super().__init__(env, *args, **settings)
        self._mode = autoreset_mode_of(env)
        self._over = np.zeros(env.num_envs, dtype=bool)  # which the next step resets

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None):
        """Begin episodes, only those in ``options["reset_mask"]`` if it is given."""
        rows = (options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool)).copy()
        self._begin(rows)
        self._over &= ~rows
        return self.env.reset(seed=seed, options=options)

    def step(self, actions: Any):
        """Send the environments what the actuators make of ``actions`` ``(N, A)``."""
        actions = as_numbers("actions", actions, self.env.action_space.shape)
        self.effect = self._effects(actions)
        observations, rewards, terminated, truncated, infos = self.env.step(self.effect)
        over = np.asarray(terminated) | np.asarray(truncated)
        fresh = over if self._mode is AutoresetMode.SAME_STEP else self._over
        if fresh.any():
            self._begin(fresh)
        self._over = over & (self._mode is AutoresetMode.NEXT_STEP)
        return observations, rewards, terminated, truncated, infos
