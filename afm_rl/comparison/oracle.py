"""The policy, given the faults as soon as they are there: the target for corrections."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from afm_rl.comparison.policy import Acting
from afm_rl.comparison.robot import Robot
from afm_rl.dynamics import MuJoCoDynamics
from afm_rl.dynamics.linear_residual import nominal_of
from afm_rl.errors import ConfigurationError
from afm_rl.transforms.fault_wrapper import FaultVectorWrapper
from afm_rl.transforms.simulation import Simulation, states_of

REMEMBERED = 8  # commands that the lag of an actuator remembers


class Oracle:
    """Sends the commands whose effects are the actions of a policy.

    The policy is asked about the state in which its command will act, and its action is inverted. A
    limited rate is left as it is, because no command makes up for it.

    Args:
        robot: whose model predicts that state.
        envs: with the faults.
        act: the policy.
    """

    def __init__(self, robot: Robot, envs: FaultVectorWrapper, act: Acting) -> None:
        self.robot, self.envs, self.act = robot, envs, act
        space: Any = envs.single_action_space
        low, high = (torch.from_numpy(end).double() for end in (space.low, space.high))
        self.bounds = low - envs.actuators.home, high - envs.actuators.home

    def __call__(self, observations: np.ndarray, infos: dict[str, Any]) -> np.ndarray:
        """Return the commands ``(N, A)``.

        Raises:
            ConfigurationError: if commands are late, and what is observed later is not known.
        """
        if not self.envs.failed.any():
            return self.act(observations, infos)
        actuators = self.envs.actuators
        regime, static = actuators.regime, actuators.memoryless
        delays = actuators.value("delay").int()
        if delays.any():
            observations = self._at_arrival(observations, delays)
        planned = self.act(observations, {"afm": {"delay": delays.numpy()}})
        wanted = torch.as_tensor(planned).double() - actuators.home
        lag = actuators.value("lag").unsqueeze(-1)
        keep = torch.where(lag > 0, (-1 / lag).exp(), 0.0)
        wanted = (wanted - keep * lagged(actuators.past, keep)) / (1 - keep)
        return (
            regime.inverse(wanted, static, wanted[:, :1], *self.bounds) + actuators.home
        ).numpy()

    def _at_arrival(self, observations: np.ndarray, delays: Tensor) -> np.ndarray:
        """Return what is observed ``(N, O)`` when the commands of now act."""
        actuators, (model, state, observe) = self.envs.actuators, self._model
        states = torch.from_numpy(np.array(state(self.envs, observations), dtype=np.float64))
        if observe is None and np.array_equal(observations, states.numpy()):
            observe = np.asarray
        if observe is None:
            raise ConfigurationError(
                "compare: the oracle must know what is observed when late commands act; give "
                "observe=, a function from states (N, S) to observations"
            )
        for step in range(int(delays.max())):
            waits = delays > step
            command = actuators.past[waits, (delays - 1 - step)[waits].long()]  # oldest first
            static = actuators.memoryless[waits]
            effect = actuators.regime.apply(command, static, command[:, :1]) + actuators.home
            states[waits] = model(states[waits], effect)
        late, seen = (delays > 0).numpy(), np.array(observations)
        seen[late] = observe(states.numpy()[late])
        return seen

    @cached_property
    def _model(self) -> tuple[Callable[..., Tensor], Callable[..., Any], Any]:
        """The model, the state of environments, and what is observed in states, if it is known."""
        settings, envs = self.robot.vector_settings, self.envs
        inner: Any = envs.unwrapped
        model: Any = settings.get("model")
        state, observe = settings.get("state"), settings.get("observe")
        if isinstance(model, str):
            model = MuJoCoDynamics(inner.envs[0], action_map=settings.get("action_map"))
        if state is None and isinstance(nominal := nominal_of(model), MuJoCoDynamics):
            simulation = Simulation(envs)
            if observe is None and simulation.seen:
                observe = lambda states: simulation.observe(states)["observation"]  # noqa: E731
            state = lambda envs, observations: states_of(inner.envs, nominal)  # noqa: E731
        elif state is None:
            state, observe = lambda envs, observations: observations, observe or np.asarray
        return model, state, observe


def lagged(past: Tensor, keep: Tensor) -> Tensor:
    """Return where actuators with a lag are after commands ``(N, D, A)``, newest first.

    Args:
        past: the commands.
        keep: share of the last effect that a step keeps, ``(N, 1)``.

    >>> lagged(torch.tensor([[[1.0], [0.0]]]), torch.tensor([[0.25]]))
    tensor([[0.7500]])
    """
    reached, *later = past[:, :REMEMBERED].flip(1).unbind(1)
    for command in later:
        reached = command + keep * (reached - command)
    return reached
