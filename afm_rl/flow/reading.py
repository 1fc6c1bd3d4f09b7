"""What the networks of a context flow read in a context."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.flow.hints import ANSWERS, MISSES, Fits

TOLD = ANSWERS + MISSES + 1  # numbers per axis beside the code: answers, misses, what is asked


class Reading(NamedTuple):
    """What the networks read in a context, to be asked about actions."""

    code: Tensor
    """The encoder's, ``(*B, latent)``."""
    fits: Fits
    """Least squares of the window."""

    def wide(self) -> Reading:
        """Return the reading with one more dimension, to be asked of many actions."""
        return Reading(self.code.unsqueeze(-2), self.fits.wide())

    def of_plan(self, planned: Tensor, saturation: str) -> Tensor:
        """Return what a network is told of how to have a planned u ``(*B, A)`` come true."""
        return self._told(self.fits.execute(planned, saturation), planned)

    def of_effect(self, executed: Tensor) -> Tensor:
        """Return what a network is told of what an executed u ``(*B, A)`` is worth."""
        return self._told(self.fits.effect(executed), executed)

    def _told(self, answers: Tensor, unit: Tensor) -> Tensor:
        """Return the code, what the fits answer, how well they fit, and u."""
        many = unit.shape[:-1]
        code, misses = (part.expand(*many, -1) for part in (self.code, self.fits.misses))
        return torch.cat([code, answers, misses, unit], -1)
