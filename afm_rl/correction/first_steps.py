"""Warnings, given once, when most steps are corrected, or are held back by limits."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from afm_rl.errors import warn

STEPS = 60  # that are looked at together
MOST = 0.5  # share of them, in each third but the first

CORRECTED = (
    "{share:.0f} % of the first {steps} steps were corrected ({cause}): the robot was changed "
    "before it began, or the model is wrong, which afm_rl.check_model(env, model) tells"
)
HELD_BACK = (
    "{share:.0f} % of {steps} steps were held back by the limits most and rate ({cause}): what "
    "was planned cannot be had within them; raise them, or plan for what is left"
)


class StepWarning:
    """Notes what happened in 60 steps, and warns once if it did in most of them.

    Most: more than half of the second 20, and of the third. Numbers are looked at once, at the last
    of these steps, and nothing is noted in a function that is compiled, exported or captured.

    Args:
        text: of the warning.
        again: look at later steps, too, 60 at a time, until there is something to be said.

    >>> import warnings
    >>> first = StepWarning(CORRECTED)
    >>> with warnings.catch_warnings(record=True) as said:
    ...     for _ in range(200):
    ...         first(torch.ones(3, dtype=torch.bool), lambda: "gain 0.5 on all")
    >>> [str(warning.message)[:68] for warning in said]
    ['100 % of the first 60 steps were corrected (gain 0.5 on all): the ro']
    """

    def __init__(self, text: str, again: bool = False) -> None:
        self.text, self.again = text, again
        self.happened: list[Tensor] = []

    def __call__(self, happened: Tensor, cause: Callable[[], str]) -> None:
        """Note in which missions of a step it happened.

        Args:
            happened: by mission.
            cause: returns in words what is believed of the actuators; empty if that is not known.
        """
        if len(self.happened) == STEPS or torch.compiler.is_compiling():
            return
        if happened.is_cuda and torch.cuda.is_available():
            if torch.cuda.is_current_stream_capturing():
                return
        if self.happened and self.happened[0].device != happened.device:
            self.happened.clear()  # moved to another device
        self.happened.append(happened.float().mean())
        if len(self.happened) < STEPS:
            return
        parts = torch.stack(self.happened).reshape(3, -1).mean(-1)
        if parts[1:].amin() > MOST:
            known, share = cause() or "what is wrong is not known", 100 * float(parts.mean())
            text = self.text.format(share=share, steps=STEPS, cause=known)
            warn(text)
        elif self.again:
            self.happened.clear()
