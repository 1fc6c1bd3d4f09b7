"""What environments of missions share: whose turn it is, and which mission follows."""

from __future__ import annotations

from abc import abstractmethod

from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from afm_rl.envs.mission_noise import MissionNoise
from afm_rl.envs.missions import MissionFormat
from afm_rl.errors import ConfigurationError, NonFiniteError, check_count


class MissionEnv(EnvBase):
    """A base class for environments whose state and missions travel in the tensordict.

    Subclasses fill in the attributes, ``_advance`` and ``_reset``. Noise comes from one stream per
    mission seed; the streams live in the environment.

    Attributes:
        mission_format: the entries under ``"mission"``.
        noise: the streams.
        seed: missions without a seed of their own get ``seed, seed + 1, ...``.
    """

    _supports_set_state = True
    mission_format: MissionFormat
    noise: MissionNoise
    seed: int
    _default: TensorDictBase | None = None
    _last: TensorDictBase | None = None

    @abstractmethod
    def _advance(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return what one step of missions that are all under way leads to."""

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if "mission" not in tensordict.keys() or "pose" not in tensordict.keys():
            raise ConfigurationError("the tensordict has no mission or pose: start with reset()")
        running = tensordict.get("_step", None)
        if running is None:
            return self._remembered(self._advance(tensordict))
        # Some missions of a locked batch wait while others go on.
        running = running.reshape(tensordict.batch_size)
        out = tensordict.select(*self.observation_keys, *self.done_keys).clone()
        out.update(self.full_reward_spec.zero())
        out[running] = self._advance(tensordict[running])
        return self._remembered(out)

    def _remembered(self, out: TensorDictBase) -> TensorDictBase:
        self._last = out.select("mission")
        return out

    def _missions_of(self, given: TensorDictBase | None, batch) -> TensorDict:
        """Return the missions to reset: those given, else the last ones, else the default."""
        mission = None if given is None else given.get("mission", None)
        automatic = given is not None and "_reset" in given.keys()
        if mission is None and automatic and self._last is not None:
            if self._last.batch_size == batch:
                return self._last["mission"]
        if self._default is not None:
            default = self._default.expand(batch)
            mission = default if mission is None else default.clone().update(mission)
        return self.mission_format.complete(mission, batch, self.seed, self.device)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.seed = check_count("seed", seed, low=0)
        self.noise.restart()

    def get_extra_state(self) -> dict[str, dict[str, Tensor]]:
        """Return the state of the noise streams, which ``state_dict`` contains."""
        return self.noise.state_dict()

    def set_extra_state(self, state: dict[str, dict[str, Tensor]]) -> None:
        """Restore what :meth:`get_extra_state` returned."""
        self.noise.load_state_dict(state)


def check_action(action: Tensor) -> None:
    """Check that all actions ``(*B, A)`` are finite.

    Raises:
        NonFiniteError: naming the missions whose action is not.
    """
    rows = (~action.isfinite().all(-1)).reshape(-1)
    if rows.any():
        where = rows.nonzero().flatten().tolist()
        raise NonFiniteError(
            f"`action` is NaN or infinite in missions {where}: the planner or policy broke down"
        )
