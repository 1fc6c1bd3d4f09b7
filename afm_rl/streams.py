"""Random numbers that do not depend on who else is in the batch."""

from __future__ import annotations

import math

import torch
from torch import Tensor


class Streams:
    """Normal numbers from one generator per seed, drawn for a whole batch of missions.

    Missions that carry the same seed get the same numbers, and a mission gets the same
    numbers alone as among hundreds, also after others have left the batch. That makes
    comparisons between methods paired, and costs one draw per seed instead of one per
    mission. They are drawn on the device that asks for them, by a generator per seed and device:
    the numbers of a CPU and of a GPU differ, comparisons on one are paired. The global torch
    generator is never touched.

    Args:
        salt: tells the streams of different users (planner, environment) apart.
        seed: seed of the stream used when the caller gives no seeds.

    >>> streams = Streams(salt=1)
    >>> noise = streams.normal((4, 2), seeds=torch.tensor([7, 8, 7]))
    >>> noise.shape, bool((noise[0] == noise[2]).all()), bool((noise[0] == noise[1]).all())
    (torch.Size([3, 4, 2]), True, False)
    """

    def __init__(self, salt: int = 0, seed: int = 0) -> None:
        self.salt = salt
        self.seed = seed
        self._generators: dict[tuple[int, torch.device], torch.Generator] = {}
        self._asked: tuple[Tensor | None, int] = None, 0
        self._seeds: list[int] = []

    def manual_seed(self, seed: int) -> None:
        """Start every stream afresh, the default one from ``seed``."""
        self.seed = seed
        self._generators.clear()

    def generator(
        self, seed: int | None = None, device: torch.device | str = "cpu"
    ) -> torch.Generator:
        """Return the generator of one seed on a device."""
        key = self.seed if seed is None else seed, torch.device(device)
        if key not in self._generators:
            # Odd factors spread both over the 64-bit seed space.
            mixed = (key[0] * 2 + 1) * 0x9E3779B97F4A7C15 + self.salt * 0x632BE59BD9B4E019
            generator = torch.Generator(key[1]).manual_seed(mixed & (2**63 - 1))
            self._generators[key] = generator
        return self._generators[key]

    def normal(
        self,
        shape: tuple[int, ...],
        *,
        batch: torch.Size | tuple[int, ...] = (),
        seeds: Tensor | None = None,
        bound: float | None = None,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> Tensor:
        """Draw N(0, 1), truncated to ``[-bound, bound]`` if given.

        Args:
            shape: shape of one mission's numbers.
            batch: batch shape, drawn independently when there are no ``seeds``.
            seeds: integer seeds ``(*B)``; the result is ``(*B, *shape)``.
            device: where the numbers are drawn.
            dtype: floating-point type.
        """

        def draw(size, generator):
            if bound is None:
                return torch.randn(size, generator=generator, device=device, dtype=dtype)
            edge = math.erf(bound / math.sqrt(2))
            noise = torch.empty(size, device=device, dtype=dtype)
            noise.uniform_(-edge, edge, generator=generator)
            return noise.erfinv_().mul_(math.sqrt(2)).clamp_(-bound, bound)

        if seeds is None:
            return draw((*batch, *shape), self.generator(device=device))
        if seeds.numel() == 0:
            return torch.empty((*seeds.shape, *shape), device=device, dtype=dtype)
        if self._asked[0] is not seeds or self._asked[1] != seeds._version:
            self._asked = seeds, seeds._version  # a look waits for the device
            self._seeds = seeds.flatten().tolist()
        drawn = {
            seed: draw(shape, self.generator(seed, device)) for seed in dict.fromkeys(self._seeds)
        }
        return torch.stack([drawn[seed] for seed in self._seeds]).view(*seeds.shape, *shape)

    def state_dict(self) -> dict[str, Tensor]:
        """Return every generator's state, keyed by seed and device, and the default ``seed``."""
        states = {
            f"{seed} {device}": generator.get_state()
            for (seed, device), generator in self._generators.items()
        }
        return {"seed": torch.tensor(self.seed), **states}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.manual_seed(int(state["seed"]))
        for key in state.keys() - {"seed"}:
            seed, device = key.split()
            self.generator(int(seed), device).set_state(state[key])
