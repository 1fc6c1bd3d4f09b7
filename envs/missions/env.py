"""What environments of missions share: settings, specs, resets, phases, and what follows."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from inspect import signature
from typing import Annotated, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from afm_rl.envs.missions.format import MissionFormat, MissionNoise
from afm_rl.envs.missions.settings import check_batch, check_dtype, check_missions
from afm_rl.envs.missions.simulation import PhasedSimulation
from afm_rl.errors import ConfigurationError, NonFiniteError, check_choice, check_count
from afm_rl.options import Natural, options


class MissionEnv(EnvBase):
    """A base class for environments whose state and missions travel in the tensordict.

    Subclasses make ``noise`` and ``simulation``, call :meth:`_complete`, and define
    :meth:`_advance`. Noise comes from one stream per mission seed; the streams live in the
    environment.

    Args:
        start_noise: standard deviation of the start pose.
        batch_size: number of missions, or ``()`` for any.
        device: where the tensors live.
        missions: what missions are unless ``reset`` is given others: a tensordict that
            broadcasts to ``batch_size``, or the arguments of :meth:`mission`.
        dtype: floating-point type, torch's default if None.

    Attributes:
        mission_format: the entries under ``"mission"``.
    """

    _supports_set_state = True
    mission_format: MissionFormat
    noise: MissionNoise
    simulation: PhasedSimulation
    more: Sequence[str] = ()  # arguments of `mission` beside those of the format
    _last: TensorDictBase | None = None

    @options("")
    def __init__(
        self,
        start_noise: float,
        batch_size: Sequence[int] = (),
        seed: Annotated[Natural, "seed of the first mission without a seed; the others follow"] = 0,
        device: torch.device | str | None = None,
        missions: TensorDictBase | Mapping[str, Any] | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        batch = check_batch(batch_size)
        super().__init__(device=device, batch_size=batch)
        self._batch_locked = bool(batch)
        self.dtype = check_dtype(dtype)
        self.seed, self.start_noise = seed, start_noise
        self._given = missions

    @property
    def max_steps(self) -> int:
        """Most steps of an episode."""
        return self.simulation.steps

    def _complete(self, tracks: Sequence[str], bounds: tuple[Tensor, Tensor]) -> None:
        """Set up missions and specs, once the simulation is there."""
        simulation, batch, device = self.simulation, self.batch_size, self.device
        missions, self._given = self._given, None
        self.regime, self.schedule = simulation.regime, simulation.schedule
        self.mission_format = MissionFormat(tracks, self.regime, self.schedule, self.dtype)
        if isinstance(missions, Mapping) and not isinstance(missions, TensorDictBase):
            for key in missions:
                check_choice(
                    "missions", key, (*signature(self.mission_format.build).parameters, *self.more)
                )
            missions = self.mission(**missions)
        self._default = check_missions(missions, batch)
        mission = self._missions_of(None, batch)  # a wrong default fails here
        state = simulation.begin(mission, self.dtype)
        spec = Composite(shape=batch, device=device)
        for name, value in simulation.describe(mission, state).exclude("mission").items():
            spec[name] = (
                Categorical(2, shape=value.shape, dtype=value.dtype, device=device)
                if value.dtype is torch.bool
                else Unbounded(shape=value.shape, dtype=value.dtype, device=device)
            )
        spec["mission"] = self.mission_format.spec(batch, device)
        self.observation_spec = spec  # the state as well, so that it is carried
        self.state_spec = Composite(
            {name: spec[name].clone() for name in (*state, "mission")}, shape=batch, device=device
        )
        shape = torch.Size((*batch, len(bounds[0])))
        low, high = (bound.to(device, self.dtype).expand(shape) for bound in bounds)
        box = Bounded(low=low, high=high, shape=shape, dtype=self.dtype, device=device)
        self.full_action_spec = Composite(action=box, shape=batch, device=device)
        reward = Unbounded(shape=(*batch, 1), dtype=self.dtype, device=device)
        self.full_reward_spec = Composite(reward=reward, shape=batch, device=device)
        flags = {
            name: Categorical(2, shape=(*batch, 1), dtype=torch.bool, device=device)
            for name in ("done", "terminated", "truncated")
        }
        self.full_done_spec = Composite(flags, shape=batch, device=device)

    def mission(self, *args: Any, **entries: Any) -> TensorDict:
        """Describe one mission; see :meth:`~afm_rl.envs.missions.format.MissionFormat.build`."""
        return self.mission_format.build(*args, **entries).to(self.device)

    @abstractmethod
    def _advance(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return what one step of missions that are all under way leads to."""

    def _check_pose(self, pose: Tensor) -> None:
        """Check states that missions are to go on from."""

    def _begun(self, mission: TensorDictBase, rows: Tensor | None) -> dict[str, Tensor]:
        """Return the state at the beginning of missions, of which only ``rows`` count."""
        return self.simulation.begin(mission, self.dtype)

    def _described(
        self, mission: TensorDictBase, state: dict[str, Tensor], rows: Tensor | None
    ) -> TensorDictBase:
        """Return the state and what is seen of it; missions in ``rows`` were reset."""
        return self.simulation.describe(mission, state)

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, set_state: bool = False, **kwargs
    ) -> TensorDictBase:
        batch = self.batch_size if tensordict is None else tensordict.batch_size
        given = TensorDict({}, batch) if tensordict is None else tensordict
        mission = self._missions_of(given, batch)
        rows = given.get("_reset", None)
        rows = None if rows is None else rows.reshape(batch)
        state = self._begun(mission, rows)
        if set_state and "pose" in given.keys():
            self._check_pose(given["pose"])
            state = {
                name: given.get(name, value).to(value.dtype, copy=True)
                for name, value in state.items()
            }
        elif self.start_noise:
            noise = self.noise.normal("start", mission["seed"], rows, self.dtype)
            state["pose"] = self.simulation.displaced(state["pose"], self.start_noise * noise)
        return self._remembered(self._described(mission, state, rows))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if "mission" not in tensordict.keys() or "pose" not in tensordict.keys():
            raise ConfigurationError("the tensordict has no mission or pose: start with reset()")
        running = tensordict.get("_step", None)
        if running is None:
            return self._remembered(self._checked(tensordict))
        # Some missions of a locked batch wait while others go on.
        running = running.reshape(tensordict.batch_size)
        out = tensordict.select(*self.observation_keys, *self.done_keys).clone()
        out.update(self.full_reward_spec.zero())
        out[running] = self._checked(tensordict[running])
        return self._remembered(out)

    def _checked(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Advance, unless an action is not finite."""
        rows = (~tensordict["action"].isfinite().all(-1)).reshape(-1)
        if rows.any():
            where = rows.nonzero().flatten().tolist()
            raise NonFiniteError(
                f"`action` is NaN or infinite in missions {where}: check the planner or "
                "policy; afm_rl.transforms.Guard repeats the last safe action"
            )
        return self._advance(tensordict)

    def _actuator_noise(self, seeds: Tensor) -> Tensor | None:
        if not self.regime.noisy:
            return None
        return self.noise.normal("actuator", seeds, dtype=self.dtype)

    def _remembered(self, out: TensorDictBase) -> TensorDictBase:
        self._last = out.select("pose", "goal", "mission", strict=False)
        return out

    def _missions_of(self, given: TensorDictBase | None, batch: torch.Size) -> TensorDict:
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
        self.noise.load_state_dict(state)
