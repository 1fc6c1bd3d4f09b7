"""Warnings, given once, when most steps are corrected, or are held back by limits."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from afm_rl.errors import warn

STEPS = 60  # that are judged together
CALM = 20  # steps executed as planned, after which a correction shows that something changed
MOST = 0.5  # share of the missions, and of each third of the steps but the first

CORRECTED = (
    "{share:.0f} % of the first {steps} steps were corrected ({cause}), and no {calm} steps before "
    "were executed as planned. Either the robot changed before the start, or the model is wrong. "
    "afm_rl.check_model(env, model) on the healthy robot shows which"
)
HELD_BACK = (
    "{share:.0f} % of {steps} steps were held back by the limits max_correction and "
    "max_correction_rate ({cause}): the planned effect cannot be reached within them; raise them, "
    "or plan for smaller effects"
)


class StepWarning:
    """Notes what happened in 60 steps, and warns once if it did in most of them.

    Most: more than half of the second 20, and of the third. Numbers are read once, at the last of
    these steps, and nothing is noted in a function that is compiled, exported or captured.

    Args:
        text: of the warning.
        again: judge later steps, too, 60 at a time, until there is something to report. Otherwise
            only the first 60 steps are judged, and 20 calm steps at their beginning, in which it
            did not happen in most missions, rule the warning out.

    >>> import warnings
    >>> first = StepWarning(CORRECTED)
    >>> with warnings.catch_warnings(record=True) as said:
    ...     for _ in range(200):
    ...         first(torch.ones(3, dtype=torch.bool), lambda: "gain 0.5 on all")
    >>> [str(warning.message)[:60] for warning in said]
    ['100 % of the first 60 steps were corrected (gain 0.5 on all)']
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
        self.happened.append(happened)
        if len(self.happened) < STEPS:
            return
        shares = torch.stack([each.float().mean() for each in self.happened])
        calm = not self.again and float(shares[:CALM].amax()) <= MOST
        if not calm and float(shares.reshape(3, -1).mean(-1)[1:].amin()) > MOST:
            known, share = cause() or "the cause is not known", 100 * float(shares.mean())
            warn(self.text.format(share=share, steps=STEPS, calm=CALM, cause=known))
        elif self.again:
            self.happened.clear()
