"""The noise of missions: one stream per seed, in the order of its own events."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from afm_rl.streams import Streams


class MissionNoise:
    """Start, process, sensor and actuator noise that depend on a mission's seed alone.

    Each kind draws from streams of its own, so a reset does not shift the noise of the steps, and
    rows that are left out of a call draw nothing. Rows with equal seeds share their numbers call
    by call: step them together, and they are paired.

    Args:
        kinds: by name, a salt, which separates the streams of a kind from all others, and how many
            numbers it draws, N; those of the ground robot if None.

    >>> noise = MissionNoise()
    >>> seeds = torch.tensor([3, 4, 3])
    >>> drawn = noise.normal("start", seeds, torch.tensor([True, False, True]))
    >>> bool((drawn[0] == drawn[2]).all()), drawn[1]
    (True, tensor([0., 0., 0.]))
    """

    def __init__(self, kinds: Mapping[str, tuple[int, int]] | None = None) -> None:
        kinds = UGV_NOISE if kinds is None else kinds
        self.sizes = {name: size for name, (_, size) in kinds.items()}
        self.streams = {name: Streams(salt=salt) for name, (salt, _) in kinds.items()}

    def normal(
        self,
        event: str,
        seeds: Tensor,
        rows: Tensor | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> Tensor:
        """Draw N(0, 1) numbers ``(*B, N)``.

        Args:
            event: a kind of noise, such as ``"start"``.
            seeds: seed of each mission, ``(*B)``.
            rows: missions that draw, booleans ``(*B)``; the others get zeros. All if None.
            dtype: floating-point type.
        """
        size, stream = (self.sizes[event],), self.streams[event]
        if rows is None:
            return stream.normal(size, seeds=seeds, device=seeds.device, dtype=dtype)
        noise = torch.zeros(*seeds.shape, *size, device=seeds.device, dtype=dtype)
        noise[rows] = stream.normal(size, seeds=seeds[rows], device=seeds.device, dtype=dtype)
        return noise

    def restart(self) -> None:
        """Let every stream begin again."""
        for stream in self.streams.values():
            stream.manual_seed(stream.seed)

    def state_dict(self) -> dict[str, dict[str, Tensor]]:
        """Return the states of all generators, per event."""
        return {name: stream.state_dict() for name, stream in self.streams.items()}

    def load_state_dict(self, state: dict[str, dict[str, Tensor]]) -> None:
        for name, stream in self.streams.items():
            stream.load_state_dict(state[name])


UGV_NOISE = {"start": (0x55475653, 3), "process": (0x55475650, 3), "actuator": (0x55475641, 2)}


def flight_noise(between: int) -> MissionNoise:
    """Return the noise of a quadrotor, with readings of its sensor ``between`` two ticks."""
    kinds = {"start": (0x464C5953, 3), "sensor": (0x464C594E, 12), "actuator": (0x464C5941, 4)}
    return MissionNoise({**kinds, "between": (0x464C5942, 12 * between)})
