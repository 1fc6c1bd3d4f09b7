"""Warnings, given once, when most steps are corrected, or are held back by limits."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch
from torch import Tensor

STEPS = 60  # that are looked at together
MOST = 0.5  # share of them, in each third but the first


class FirstSteps:
    """Notes which of the first 60 steps are corrected, and warns if most of them are.

    Most: more than half of the second 20, and of the third. Numbers are looked at once, at the last
    of these steps, and nothing is noted in a function that is compiled, exported or captured.

    >>> first = FirstSteps()
    >>> with warnings.catch_warnings(record=True) as said:
    ...     for _ in range(200):
    ...         first(torch.ones(3, dtype=torch.bool), lambda: "gain 0.5 on all")
    >>> [str(warning.message)[:68] for warning in said]
    ['100 % of the first 60 steps were corrected (gain 0.5 on all): the ro']
    """

    text = (
        "{share:.0f} % of the first {steps} steps were corrected ({cause}): the robot was changed "
        "before it began, or the model is wrong, which afm_rl.check_model(env, model) tells"
    )
    again = False
    """Are later steps looked at, too, until there is something to be said?"""

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
            known, share = cause() or "what is wrong is not known", 100 * float(parts.mean())
            text = self.text.format(share=share, steps=STEPS, cause=known)
            warnings.warn(text, stacklevel=3)
        elif self.again:
            self.corrected.clear()


class HeldBack(FirstSteps):
    """Notes at which steps the user's limits hold a correction back, and warns at most once.

    It looks at 60 steps at a time, over the whole mission.
    """

    text = (
        "{share:.0f} % of {steps} steps were held back by the limits most and rate ({cause}): what "
        "was planned cannot be had within them; raise them, or plan for what is left"
    )
    again = True
