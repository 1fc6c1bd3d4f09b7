"""The noise of flights: one stream per seed, in the order of its own events."""

from __future__ import annotations

from afm_rl.envs.mission_noise import MissionNoise


class FlightNoise(MissionNoise):
    """Start (a position), sensor (a tangent vector) and actuator noise of a mission's seed.

    >>> import torch
    >>> FlightNoise().normal("sensor", torch.tensor([3, 4])).shape
    torch.Size([2, 12])
    """

    salts = {"start": 0x464C5953, "sensor": 0x464C594E, "actuator": 0x464C5941}
    sizes = {"start": 3, "sensor": 12, "actuator": 4}
