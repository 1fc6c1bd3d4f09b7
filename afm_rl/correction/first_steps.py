"""Corrections from the first step on: a robot that was changed before, or a wrong model."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch
from torch import Tensor

STEPS = 60  # the first ones
MOST = 0.5  # share of those that are corrected, in each third but the first


class FirstSteps:
    """Notes which of the first 60 steps are corrected, and warns if most of them are, all along.

    Numbers are looked at once, at the last of these steps, and nothing is noted in a function that
    is compiled, exported or captured.

    >>> first = FirstSteps()
    >>> with warnings.catch_warnings(record=True) as said:
    ...     for _ in range(200):
    ...         first(torch.ones(3, dtype=torch.bool), lambda: "gain 0.5 on all")
    >>> [str(warning.message)[:68] for warning in said]
    ['100 % of the first 60 steps were corrected (gain 0.5 on all): the ro']
    """

    def __init__(self) -> None:
        self.corrected: list[Tensor] = []

    def __call__(self, corrected: Tensor, cause: Callable[[], str]) -> None:
        """Note whether the missions of a step are corrected.

        Args:
            corrected: by mission.
            cause: returns in words what is believed of the actuators; empty if that is not known.
        """
        if len(self.corrected) == STEPS or torch.compiler.is_compiling():
            return
        if corrected.is_cuda and torch.cuda.is_available():
            if torch.cuda.is_current_stream_capturing():
                return
        if self.corrected and self.corrected[0].device != corrected.device:
            self.corrected.clear()  # moved to another device
        self.corrected.append(corrected.float().mean())
        if len(self.corrected) < STEPS:
            return
        parts = torch.stack(self.corrected).reshape(3, -1).mean(-1)
        if parts[1:].amin() > MOST:
            warnings.warn(
                f"{100 * parts.mean():.0f} % of the first {STEPS} steps were corrected "
                f"({cause() or 'what is wrong is not known'}): the robot was changed before it "
                "began, or the model is wrong, which afm_rl.check_model(env, model) tells",
                stacklevel=3,
            )
