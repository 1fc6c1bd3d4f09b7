"""How likely one method does better than another."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from afm_rl.report.bootstrap import RESAMPLES, Bounds, bounds


def probability_of_improvement(mine: pd.DataFrame, other: pd.DataFrame) -> tuple[float, Bounds]:
    r"""Return :math:`P(X > Y)` with its 95 % interval (Agarwal et al. 2021).

    .. math:: \frac{1}{C} \sum_c \frac{1}{n_c m_c} \sum_{i, j}
              [x_{ci} > y_{cj}] + \tfrac{1}{2} [x_{ci} = y_{cj}]

    Within each cell that both methods have, every mission of one meets every mission of the
    other, whatever their seeds; cells count alike. The interval draws the missions of both
    anew within cells. NaN if no cell is shared.

    Args:
        mine: missions of one method, with ``cell`` and ``score``.
        other: those of the other one.

    >>> mine = pd.DataFrame({"cell": ["a", "a"], "score": [1, 3]})
    >>> probability_of_improvement(mine, pd.DataFrame({"cell": ["a"], "score": [1]}))[0]
    0.75
    """
    scores = [frame.groupby("cell")["score"].agg(list) for frame in (mine, other)]
    shared = scores[0].index.intersection(scores[1].index)
    if shared.empty:
        return math.nan, (math.nan, math.nan)
    rng, total, drawn = np.random.default_rng(0), 0.0, np.zeros(RESAMPLES)
    for cell in shared:
        x, y = (np.asarray(score[cell]) for score in scores)
        won = 0.5 * (np.sign(x[:, None] - y) + 1)
        # How often each mission is drawn: as good as drawing them, and two small products.
        often = [rng.multinomial(len(v), np.full(len(v), 1 / len(v)), RESAMPLES) for v in (x, y)]
        total += won.mean()
        drawn += np.einsum("ri,ij,rj->r", often[0], won, often[1], optimize=True) / won.size
    return float(total / len(shared)), bounds(drawn / len(shared))
