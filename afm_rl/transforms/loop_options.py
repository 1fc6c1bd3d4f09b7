"""The options of the loop: one record, which all that stand around the loop hand through."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, TypedDict

from annotated_types import Interval

from afm_rl.options import Default

Limit = float | Sequence[float] | None


class LoopOptions(TypedDict, total=False):
    """Options of the loop, which transform, policy and wrappers take by name and hand through.

    They are attributes of these, too: ``enabled``, ``most`` and ``rate`` may be changed at any
    step. Each is written here and nowhere else.

    * ``delay`` is used from the first step on. Faster axes are kept waiting, and what comes on top
      is found out.
    * With ``keep_memory_on_reset`` the pairs, the noise and the belief of the newest step go on, as
      where a fault outlasts episodes. So rollouts depend on those before them, and branches of
      rollouts are not exact. Else each episode begins with an empty memory.
    * ``most`` and the action box bound what ``rate`` asks for. Each episode begins with no
      difference.
    * What is recorded are planned, executed and effective action and the state of each step.
    """

    enabled: Annotated[bool, Default(True), "False: watch, gather evidence, correct nothing"]
    most: Annotated[
        Limit,
        Interval(gt=0, le=2),
        "how far from the plan, half ranges, one number or one per axis; None: no limit",
    ]
    rate: Annotated[
        Limit, Interval(gt=0, le=2), "how much that may change in a step, likewise; None: no limit"
    ]
    extend_action_box: Annotated[
        bool,
        Default(True),
        "tell planners of effects beyond the action box, if the model can predict them",
    ]
    delay: Annotated[
        int | Sequence[int] | None, "known steps from an action to its effect, of all or each axis"
    ]
    delay_compensation: Annotated[
        bool,
        Default(True),
        "what is observed when the next action acts is shown (a Smith predictor); False: measured",
    ]
    belief: Annotated[bool, Default(False), "tell the belief, too"]
    keep_memory_on_reset: Annotated[
        bool, Default(False), "episodes go on with what was learnt; False: each learns anew"
    ]
    record: Annotated[Any, "new file, .csv, of each step, as afm-rl-diagnose reads it; None: none"]
