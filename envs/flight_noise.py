"""The noise of flights: one stream per seed, in the order of its own events."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.envs.mission_noise import MissionNoise
from afm_rl.streams import Streams

_SALTS = {"start": 0x464C5953, "sensor": 0x464C594E, "actuator": 0x464C5941}
_SIZES = {"start": 3, "sensor": 12, "actuator": 4}


class FlightNoise(MissionNoise):
    """Start, sensor and actuator noise that depend on a mission's seed alone.

    >>> noise = FlightNoise()
    >>> noise.normal("sensor", torch.tensor([3, 4])).shape
    torch.Size([2, 12])
    """

    def __init__(self) -> None:
        self.streams = {name: Streams(salt=salt) for name, salt in _SALTS.items()}

    def normal(
        self,
        event: str,
        seeds: Tensor,
        rows: Tensor | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> Tensor:
        """Draw N(0, 1) numbers ``(*B, N)``.

        Args:
            event: ``"start"`` (N is 3, a position), ``"sensor"`` (12, a tangent vector) or
                ``"actuator"`` (4, an action).
            seeds: seed of each mission, ``(*B)``.
            rows: missions that draw, booleans ``(*B)``; the others get zeros. All if None.
            dtype: floating-point type.
        """
        size = _SIZES[event]
        noise = torch.zeros(*seeds.shape, size, device=seeds.device, dtype=dtype)
        rows = torch.ones_like(seeds, dtype=torch.bool) if rows is None else rows
        noise[rows] = self.streams[event].normal(
            (size,), seeds=seeds[rows], device=seeds.device, dtype=dtype
        )
        return noise
