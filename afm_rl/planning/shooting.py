"""TorchRL's own planners, under the names this library's configuration uses."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.modules import CEMPlanner, MPPIPlanner
from torchrl.objectives.value import TDLambdaEstimator

from afm_rl.errors import ConfigurationError, check_count, check_instance, check_number
from afm_rl.planning.planning_env import raise_missing


def _check(env: EnvBase, horizon: int, population: int, iterations: int, elites: int) -> None:
    """Check what both planners share."""
    if check_instance("planner.env", env, EnvBase).action_keys != ["action"]:
        raise ConfigurationError(
            f"planner: TorchRL's planners write 'action', but {type(env).__name__} reads "
            f"{env.action_keys}; rename it, or choose MPPI or ICEM"
        )
    check_count("planner.horizon", horizon, high=10_000)
    check_count("planner.population", population, high=1_000_000)
    check_count("planner.iterations", iterations, high=10_000)
    if check_count("planner.elites", elites) > population:
        raise ConfigurationError(
            f"planner.elites={elites}: expected at most planner.population={population}"
        )


class CEM(CEMPlanner):
    """TorchRL's cross-entropy planner. It starts cold at every step.

    Args:
        env: batch-unlocked environment to plan in.
        horizon: steps of a plan.
        population: candidates per iteration.
        iterations: refinements per step.
        elites: candidates that the next iteration is fitted to.

    Raises:
        ConfigurationError: for a setting or environment that cannot be used.
    """

    def __init__(
        self,
        env: EnvBase,
        horizon: int = 5,
        population: int = 300,
        iterations: int = 3,
        elites: int = 30,
    ) -> None:
        _check(env, horizon, population, iterations, elites)
        super().__init__(env, horizon, iterations, population, elites)

    def planning(self, tensordict: TensorDictBase) -> Tensor:
        """Plan on the entries needed: the base class copies all of them per candidate."""
        raise_missing(self.env, tensordict)
        return super().planning(tensordict.select(*self.in_keys))


class TorchRLMPPI(MPPIPlanner):
    """TorchRL's MPPI: cross-entropy with exponential weights on the elites, starting cold.

    The value beyond the horizon is taken to be zero.

    Args:
        env: batch-unlocked environment to plan in.
        horizon: steps of a plan.
        population: candidates per iteration.
        iterations: refinements per step.
        elites: candidates that the next iteration is fitted to.
        temperature: multiplies the returns (an inverse temperature).
    """

    def __init__(
        self,
        env: EnvBase,
        horizon: int = 5,
        population: int = 300,
        iterations: int = 3,
        elites: int = 30,
        temperature: float = 1.0,
    ) -> None:
        _check(env, horizon, population, iterations, elites)
        check_number("planner.temperature", temperature, low=0.0, open_low=True)
        keys = list(env.observation_spec.keys(True, True))
        value = TensorDictModule(
            lambda observation: torch.zeros_like(observation[..., :1]), keys[:1], ["state_value"]
        )
        returns = TDLambdaEstimator(gamma=1.0, lmbda=1.0, value_network=value)
        super().__init__(env, returns, temperature, horizon, iterations, population, elites)

    def planning(self, tensordict: TensorDictBase) -> Tensor:
        """Plan on the entries needed: the base class copies all of them per candidate."""
        raise_missing(self.env, tensordict)
        return super().planning(tensordict.select(*self.env.observation_spec.keys(True, True)))
