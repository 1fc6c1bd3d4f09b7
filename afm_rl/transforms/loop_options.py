"""The options of the loop: one record, which all that stand around the loop hand through."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, TypedDict

from annotated_types import Gt, Le

from afm_rl.options import Default, Natural

Limit = Annotated[float | Sequence[float] | None, Gt(0), Le(2)]


class LoopOptions(TypedDict, total=False):
    """Options of the loop, which transform, policy and wrappers take by name and hand through.

    They are attributes of these, too: ``enabled``, ``max_correction`` and
    ``max_correction_rate`` may be changed at any step. Each is written here and nowhere else.

    * ``delay`` is used from the first step on. Faster axes wait, and any additional delay is
      estimated.
    * With ``keep_memory_on_reset`` the pairs, the noise and the belief of the newest step are kept,
      for faults that outlast episodes. So rollouts depend on those before them, and branches of
      rollouts are not exact. Else each episode begins with an empty memory.
    * ``max_correction`` and the action bounds hold also where ``max_correction_rate`` would allow
      more. Each episode begins without a correction.
    * With ``residual_steps`` what the model misses of each robot is fitted once, when this many
      valid steps are available and do not look like a fault; until then the nominal model is used.
    * What is recorded are planned, executed and effective action and the state of each step.
    """

    enabled: Annotated[bool, Default(True), "False: observe and estimate, correct nothing"]
    max_correction: Annotated[
        Limit, "largest distance from the plan, half ranges, all or each axis; None: no limit"
    ]
    max_correction_rate: Annotated[
        Limit, "largest change of that distance per step, all or each axis; None: no limit"
    ]
    extend_effect_bounds: Annotated[
        bool,
        Default(True),
        "allow planners effects beyond the action bounds, if the model predicts them",
    ]
    delay: Annotated[int | Sequence[int] | None, "known delay in steps, of all axes or of each"]
    delay_compensation: Annotated[
        bool,
        Default(True),
        "observe the predicted state in which the action acts; False: the measured one",
    ]
    belief: Annotated[bool, Default(False), "also report the belief"]
    keep_memory_on_reset: Annotated[
        bool, Default(False), "keep the memory across episodes; False: each episode starts empty"
    ]
    residual_steps: Annotated[
        Natural,
        Default(0),
        "healthy steps to which the model is fitted; 0: no fit, otherwise at least 50",
    ]
    record: Annotated[Any, "new file, .csv, of each step, as afm-rl-diagnose reads it; None: none"]
