"""What the paper's text claims of its ground robot, recomputed from its tables and from missions.

Each claim is an effect, positive where it is as claimed, of the means over seeds in each scenario.
Methods stand in the order in which a claim names them: AFM first, but where another is judged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from afm_rl.report.learning import recovery_times
from afm_rl.report.statistics import resampled_bounds, split
from afm_rl.report.tables import Table, interval_text

LAST = 4999  # step of a published mission that ran out
MEASURES = ["success", "steps", "late", "loss", "recovery"]
SUCCESS, STEPS, LATE, LOSS, RECOVERY = range(len(MEASURES))
AFM = "afm"  # a form of ours takes its place
TITLE = "What the text claims"
NOTE = (
    "Effects in favour of each claim, of means over seeds in 22 scenarios, with 95 % stratified "
    "bootstrap intervals (strata: scenarios). It *holds* where the interval is above 0 and reaches "
    "what is claimed, *but less* where it does not reach it; it *does not hold* where the interval "
    "is below 0, or holds 0 and not what is claimed. Out of time: no seed reached every target. "
    "Best of AFM and its ablations by success or by steps, as printed in bold: ties of success go "
    "to AFM. Worst: out of time, or the most steps of these. Ahead: by success, then by steps. "
    "Loss: the median after the change, until it is undone. Nominal level: that of the report's "
    "recovery times; never counts as all of these steps."
)


class Claim(NamedTuple):
    """A sentence of the text as a number."""

    words: str
    text: str
    """As the paper puts it."""
    size: float
    """What is claimed; 0: the direction alone."""
    methods: tuple[str, ...]
    effect: Callable[[np.ndarray], np.ndarray]
    """Takes means ``(S, M, K, ...)`` of scenarios, methods and measures, returns ``(...)``."""
    digits: int


def more_success(means: np.ndarray) -> np.ndarray:
    """Return how many points of success the first method has over the second."""
    return 100 * (means[:, 0, SUCCESS] - means[:, 1, SUCCESS]).mean(0)


def share_of_steps(means: np.ndarray) -> np.ndarray:
    """Return how many per cent fewer steps the first method takes than the second."""
    steps = means[:, :, STEPS].mean(0)
    return 100 * (1 - steps[0] / steps[1])


def less(measure: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return by how much a measure of the first method is below that of the second."""
    return lambda means: (means[:, 1, measure] - means[:, 0, measure]).mean(0)


def less_variance(means: np.ndarray) -> np.ndarray:
    """Return by how much the variance of success over scenarios is below that of the second."""
    return means[:, 1, SUCCESS].var(0) - means[:, 0, SUCCESS].var(0)


def less_often_late(means: np.ndarray) -> np.ndarray:
    """Return in how many scenarios fewer than the second the first runs out of time."""
    late = (means[:, :, LATE] == 1).sum(0)
    return late[1] - late[0]


def worst(means: np.ndarray) -> np.ndarray:
    """Return in how many scenarios the last method is out of time, or takes the most steps."""
    steps = means[:, :, STEPS]
    return ((means[:, -1, LATE] == 1) | (steps[:, -1] >= steps.max(1))).sum(0)


def more_often_best(means: np.ndarray) -> np.ndarray:
    """Return in how many scenarios more than the last the first is best, as printed in bold."""
    best = means[:, :, SUCCESS].argmax(1)  # the first of those that are equal
    fastest = np.where((means[:, :, LATE] == 1).all(1), -1, means[:, :, STEPS].argmin(1))
    last = means.shape[1] - 1
    first, other = (((best == place) | (fastest == place)).sum(0) for place in (0, last))
    return first - other


def more_often_ahead(means: np.ndarray) -> np.ndarray:
    """Return in how many scenarios more the first is ahead than behind: by success, then steps."""
    success, steps = (means[:, 0, k] - means[:, 1, k] for k in (SUCCESS, STEPS))
    return np.where(success == 0, -np.sign(steps), np.sign(success)).sum(0)


OVER_ONLINE, OVER_PHYSICS = (AFM, "online_pe"), (AFM, "physics")
ABLATIONS, RANDOMISED = (AFM, "frozen_pe", "online_pe"), ("afm_dr", AFM)
CLAIMS = [
    Claim("success over Physics (points)", "34.2", 34.2, OVER_PHYSICS, more_success, 1),
    Claim("success over Online PE (points)", "more", 0, OVER_ONLINE, more_success, 1),
    Claim("fewer steps than Physics (%)", "15.1", 15.1, OVER_PHYSICS, share_of_steps, 1),
    Claim("variance of success, less than Physics", "0.05", 0.05, OVER_PHYSICS, less_variance, 3),
    Claim("out of time, less often than Physics", "10", 10, OVER_PHYSICS, less_often_late, 0),
    Claim("Online PE is worst", "9", 9, ABLATIONS, worst, 0),
    Claim("best, more often than Online PE", "12", 12, ABLATIONS, more_often_best, 0),
    Claim("ahead of Online PE, not behind", "more", 0, OVER_ONLINE, more_often_ahead, 0),
    Claim("AFM+DR: success over AFM (points)", "2.2", 2.2, RANDOMISED, more_success, 1),
    Claim("AFM+DR: fewer steps than AFM", "146.7", 146.7, RANDOMISED, less(STEPS), 0),
    Claim("loss, lower than Online PE's", "lower", 0, OVER_ONLINE, less(LOSS), 2),
    Claim("back at the nominal level, steps sooner", "faster", 0, OVER_ONLINE, less(RECOVERY), 0),
]


def learning(steps: pd.DataFrame) -> pd.DataFrame:
    """Return ``loss`` and ``recovery`` of each mission, from its steps.

    Args:
        steps: with ``mission``, ``loss``, ``error`` and ``regime_active``.
    """
    rows = {}
    for mission, course in steps.groupby("mission"):
        changed = course[course["regime_active"] == 1]
        times = recovery_times(course).query("of == 'model' and change == 1")["time"]
        recovery = times.clip(upper=len(changed)).mean()
        rows[mission] = {"loss": changed["loss"].median(), "recovery": recovery}
    return pd.DataFrame.from_dict(rows, "index", columns=["loss", "recovery"])


def samples_of(missions: pd.DataFrame, methods: Sequence[str]) -> list[np.ndarray]:
    """Return the measures ``(N, M, K)`` of each scenario, of the seeds that all methods have.

    Args:
        missions: with ``method``, ``scenario``, ``seed`` and measures; a missing one is NaN.
        methods: which are compared.
    """
    wide = missions.reindex(columns=["scenario", "seed", "method", *MEASURES])
    wide = wide.pivot(index=["scenario", "seed"], columns="method", values=MEASURES)
    wide = wide.reindex(columns=pd.MultiIndex.from_product([MEASURES, methods]))
    wide = wide.dropna(subset=[("success", method) for method in methods]).astype(float)
    values = np.stack([wide[measure].to_numpy() for measure in MEASURES], -1)
    return split(values, wide.index.get_level_values("scenario"))


def estimated(claim: Claim, samples: list[np.ndarray]) -> dict[str, float]:
    """Return the effect with its interval, which is NaN where one seed shows none."""

    def effect(drawn: list[np.ndarray]) -> np.ndarray:
        return claim.effect(np.stack([seeds.mean(-1) for seeds in drawn])).astype(float)

    value = float(effect([np.moveaxis(seeds, 0, -1) for seeds in samples]))
    low = high = math.nan
    if not math.isnan(value) and any(len(seeds) > 1 for seeds in samples):
        low, high = np.nan_to_num(resampled_bounds(samples, effect), nan=value)
    return {"effect": value, "effect_low": float(low), "effect_high": float(high)}


def verdict(size: float, low: float, high: float) -> str:
    """Return what an interval says of a claim of some size, 0: of its direction alone."""
    if low > 0:
        return "holds" if high >= size else "holds, but less"
    return "does not hold" if high < size else "undecided"


def shown(claim: Claim, effect: dict[str, float], judged: bool) -> str:
    """Return an effect as text, with its interval and, of ours, what it says of the claim."""
    text = interval_text(effect, "effect", claim.digits, sign="+")
    if not judged:
        return text
    ends = effect["effect_low"], effect["effect_high"]
    return f"{text}: {'one seed' if math.isnan(ends[0]) else verdict(claim.size, *ends)}"


def claims_table(
    missions: pd.DataFrame, printed: pd.DataFrame, forms: dict[str, str], more: str = ""
) -> Table:
    """Return the claims: as the text, the printed tables and forms of AFM of ours have them.

    Nothing is said of missions in a part of the scenarios.

    Args:
        missions: ours.
        printed: the printed means, in the same columns, AFM's under its name.
        forms: methods of ours that take AFM's place, and their names.
        more: what else a reader must know.
    """
    rows, numbers, scenarios = [], [], printed["scenario"].nunique()
    for claim in CLAIMS:
        row = {"claim": claim.words, "the text": claim.text}
        for form, head in {AFM: "its tables", **forms}.items():
            methods = [form if name == AFM else name for name in claim.methods]
            samples = samples_of(printed if form == AFM else missions, methods)
            effect = dict.fromkeys(["effect", "effect_low", "effect_high"], math.nan)
            if len(samples) == scenarios:
                effect = estimated(claim, samples)
            numbers.append({"claim": claim.words, "of": form, "claimed": claim.size, **effect})
            row[head] = "-" if math.isnan(effect["effect"]) else shown(claim, effect, form != AFM)
        rows.append(row)
    return Table("paper_claims", TITLE, NOTE + more, pd.DataFrame(numbers), pd.DataFrame(rows))
