"""What the networks of a context flow read in a context."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.flow.hints import ANSWERS, GUESSES, MISSES, Fits, shapes_of

TOLD = ANSWERS + MISSES + 1  # numbers per axis beside the code: answers, misses, what is asked


class Reading(NamedTuple):
    """What the networks read in a context, to be asked about actions."""

    code: Tensor
    """The encoder's, ``(*B, latent)``."""
    fits: Fits
    """Least squares of the window."""

    def pack(self) -> Tensor:
        """Return all of it as one tensor ``(*B, P)``, to be remembered."""
        first = self.code.dim() - 1
        fits = torch.cat([part.flatten(first) for part in self.fits], -1)
        return torch.cat([self.code, fits.to(self.code)], -1)

    @classmethod
    def unpack(cls, packed: Tensor, latent: int, rows: int, size: int) -> Reading:
        """Return what was packed, for K ``rows`` and actions of a size."""
        code, fits = packed.tensor_split([latent], -1)
        shapes = shapes_of(rows, size)
        parts = fits.split([shape.numel() for shape in shapes], -1)
        pairs = zip(parts, shapes, strict=True)
        return cls(code, Fits(*(part.unflatten(-1, shape) for part, shape in pairs)))

    def of_plan(self, planned: Tensor, saturation: str) -> Tensor:
        """Return what a network is told of how to have a planned u ``(*B, A)`` come true."""
        return self._told(self.fits.execute(planned, saturation), planned)

    def of_effect(self, executed: Tensor) -> Tensor:
        """Return what a network is told of what an executed u ``(*B, A)`` is worth."""
        return self._told(self.fits.effect(executed), executed)

    def guesses(self, told: Tensor) -> Tensor:
        """Return the answers ``(*B, 5, A)`` in what a network was told that may be right."""
        first, size = self.code.shape[-1], self.fits.rub.shape[-1]
        return told.narrow(-1, first, GUESSES * size).unflatten(-1, (GUESSES, size))

    def _told(self, answers: Tensor, unit: Tensor) -> Tensor:
        """Return the code, what the fits answer, how well they fit, and u."""
        many = unit.shape[:-1]
        code, misses = (part.expand(*many, -1) for part in (self.code, self.fits.misses))
        return torch.cat([code, answers, misses.to(code), unit], -1)
