"""The noise of flights: one stream per seed, in the order of its own events."""

from __future__ import annotations

from collections.abc import Mapping

from afm_rl.envs.mission_noise import MissionNoise


class FlightNoise(MissionNoise):
    """Start (a position), sensor (a tangent vector) and actuator noise of a mission's seed.

    Args:
        between: readings of the sensor between those of two ticks.

    >>> import torch
    >>> FlightNoise().normal("sensor", torch.tensor([3, 4])).shape
    torch.Size([2, 12])
    """

    salts = {
        "start": 0x464C5953,
        "sensor": 0x464C594E,
        "between": 0x464C5942,
        "actuator": 0x464C5941,
    }

    def __init__(self, between: int = 0) -> None:
        super().__init__()
        self.sizes: Mapping[str, int] = {
            "start": 3,
            "sensor": 12,
            "between": 12 * between,
            "actuator": 4,
        }
