"""The options of the action flow: one record."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, TypedDict

from annotated_types import Le

from afm_rl.correction.achievable import Saturation
from afm_rl.correction.base import LONGEST
from afm_rl.correction.hypotheses import LONGEST_DELAY, USUAL_DELAY
from afm_rl.options import Count, Default, Natural, NonNegative, Positive, Share

Delay = Annotated[Natural | Sequence[Natural], Default(0), Le(LONGEST)]
Lateness = Annotated[Natural, Default(USUAL_DELAY), Le(LONGEST_DELAY)]
Code = Literal["auto", "c", "eager"]
SIZES = (*range(1, 9), 12, 29)  # numbers of actuators for which there are graphs of the core
FASTER = 12  # actuators up to which C was measured faster than torch


class FlowOptions(TypedDict, total=False):
    """Options of the action flow, which it takes by name."""

    # What is known of the robot.
    delay: Annotated[Delay, "known steps to its effect, of all or each"]
    home: Annotated[Sequence[float] | None, "action at rest, as a pose; None: zero"]
    place: Annotated[Sequence[Natural], Default(()), "state coordinates in which ground may differ"]

    # What may have changed, and the pairs from which that is told.
    hypotheses: Annotated[Sequence[str] | None, "context windows and delays; None: all"]
    longest_delay: Annotated[Lateness, "steps of a delay that is looked for"]
    plain: Annotated[float, Default(-6.0), "prior log-odds of linear models against the network"]
    memory: Annotated[Count, Default(80), "transitions that are remembered"]
    rows: Annotated[Count | None, "pairs of a context window; None: 12, or more"]

    # How fast it is believed.
    odds: Annotated[NonNegative, Default(1.0), "prior log-odds that nothing has changed"]
    discount: Annotated[Share, Default(0.95), "of losses; .95: looks back on 20 steps"]
    noise: Annotated[
        NonNegative, Default(0.05), "unexplained at first, a share of the largest action"
    ]
    noise_rate: Annotated[Share, Default(0.1), "share of its square renewed at every step"]
    quiet: Annotated[
        NonNegative, Default(1.0), "innovation that is left alone, standard deviations"
    ]
    tails: Annotated[Positive, Default(1.0), "degrees of freedom of Student-t residuals"]

    # How the action is found.
    samples: Annotated[Count, Default(16), "starting points of the flow"]
    source_std: Annotated[
        NonNegative, Default(0.3), "of these, sigma, a share of the largest action"
    ]
    steps: Annotated[Count, Default(1), "midpoint steps"]
    saturation: Annotated[Saturation, Default("mixed")]
    core: Annotated[Code, Default("auto"), "auto: in C where it is faster; c: always; eager: torch"]
