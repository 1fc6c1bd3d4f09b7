"""The hypotheses about what an actuator may do: one table."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

MAX_DELAY = 8  # steps
FIXED = 1e12  # prior precision of a coefficient that is known
FREE, FREE_OFFSET, FREE_SLOW_GAIN = 1e-4, 1e-3, 1e-6  # prior precisions of fitted ones
FIT_LOG_ODDS, CURVE_LOG_ODDS, SHARED_LOG_ODDS = -6.0, -4.0, -2.0
TREND_FORGETTING = 0.95
SENSOR_SMOOTHING = 0.7  # of the misses that sensor noise explains
LAG_BOUNDS = (0.0, 0.9)  # of the share that an actuator keeps of its last effect
LOSS_RANGE = 16.0  # nats that a hypothesis may fall behind: a change may come at any step
NO_FAULT, RECENT_CHANGE = "no fault", "a recent change"
STEPS_AS_DISTANCE = 60.0  # that make a pair as strange as a unit of distance
LEAST_GAIN = 0.02  # gain below which a command has no effect
GRID, PROBES = 201, 32  # commands among which a curve is inverted; from all over the box

Function = Callable[[Tensor], Tensor]
Feature = str | Function
PAST = ("effect", "miss 1", "miss 2", "sensor", "age")
CURVES = {"saturating": 1.5, "slipping": 5.0}  # rates r of u exp(-r |u|)


class Hypothesis(NamedTuple):
    r"""A row of the table: an effect is linear in features of one actuator.

    .. math:: v = \theta^\top x + \varepsilon,\qquad
              \theta \sim \mathcal N(m, s^2 \operatorname{diag}(\lambda)^{-1})

    Features are ``"u-0"`` to ``"u-8"``, the command that many steps ago; ``"effect"``, the last
    effect minus the present command; ``"miss 1"`` and ``"miss 2"``, effect minus command one and
    two steps ago; ``"sensor"``, a smoothed miss, negated; ``"age"``, the command times tens of
    steps since; ``"saturating"``, ``"slipping"`` and ``"|u|"``, functions of the present command;
    ``"1"``; or a function of your own, from commands to numbers of the same shape.

    >>> Hypothesis("dead zone", (lambda u: u.sign() * (u.abs() - 0.2).clamp_min(0),), (1.0,)).cause
    'a recent change'
    """

    name: str
    features: tuple[Feature, ...]
    mean: tuple[float, ...]
    precision: tuple[float, ...] = (FREE,)
    log_prior: float = 0.0
    """Log-odds against the other faults."""
    forgetting: float = 1.0
    """Weight of a pair against the next one."""
    bounds: tuple[float, float] = (-math.inf, math.inf)
    """Of the last coefficient."""
    delay: int = 0
    """Steps from a command to its effect."""
    healthy: bool = False
    """Is there nothing to correct, or nothing that can be corrected?"""
    nearness: float = 0.0
    """Weigh pairs by their distance in the context coordinates, with this rate; 0: by age."""
    shared: bool = False
    """Do all actuators have the same coefficients?"""
    feature_variance: float = 0.0
    """Noise of the features themselves, in variances of the effects' noise."""
    cause: str = RECENT_CHANGE


def hypotheses(max_delay: int = MAX_DELAY, by_context: bool = False) -> list[Hypothesis]:
    """Return the rows that are linear in features of one actuator; the first is *no fault*.

    >>> [row.name for row in hypotheses(max_delay=0)][:3]
    ['no fault', 'sensor noise', 'reversed']
    """
    u, line, known, free = ("u-0",), ("u-0", "1"), (FIXED,), (FREE,)
    free_line, lagging = (FREE, FREE_OFFSET), ("u-0", "effect")
    of_trend = (FIXED, FIXED, FREE)
    curved, signed = ("saturating", "slipping", "u-0"), ("|u|", "u-0")
    row = Hypothesis
    rows = [
        row("no fault", u, (1,), known, healthy=True, cause=NO_FAULT),
        row("sensor noise", ("u-0", "sensor"), (1, 1), known * 2, healthy=True,
            cause="sensor noise"),
        row("reversed", u, (-1,), known),
        row("gain", u, (1,), free, FIT_LOG_ODDS),
        row("line", line, (1, 0), free_line, FIT_LOG_ODDS),
        row("offset", line, (1, 0), (FIXED, FREE_OFFSET), -2.0),
        row("shared gain", u, (1,), free, SHARED_LOG_ODDS, shared=True),
        row("recent gain", u, (1,), free, -1.0, forgetting=0.6),
        row("recent line", line, (1, 0), free_line, -1.0, forgetting=0.85),
        row("fading", ("age", "u-0"), (0, 1), free * 2, -1.0, forgetting=0.85),
        row("trend", ("u-0", "miss 2", "miss 1"), (1, -1, 2), of_trend, forgetting=TREND_FORGETTING,
            bounds=(-2, 2), feature_variance=5.0, cause="a disturbance"),
        row("lag", lagging, (1, 0.5), (FIXED, FREE), 1.1, bounds=LAG_BOUNDS, cause="slow"),
        row("lag and gain", lagging, (1, 0.5), (FREE_SLOW_GAIN, FREE), -1.3, bounds=LAG_BOUNDS,
            cause="slow"),
        row("curve", curved, (0, 0, 1), free * 3, CURVE_LOG_ODDS),
        row("by sign", signed, (0, 1), free * 2, CURVE_LOG_ODDS),
    ]  # fmt: skip
    if by_context:
        for name, nearness in (("gain near", 0.5), ("gain here", 100.0)):
            rows.append(row(name, u, (1,), free, nearness=nearness, cause="another ground"))
    for d in range(1, max_delay + 1):
        u, cause = (f"u-{d}",), f"{d} step{'s' * (d > 1)} late"
        rows += [
            row(f"late {d}", u, (1,), known, delay=d, cause=cause),
            row(f"reversed and late {d}", u, (-1,), known, -3.0, delay=d, cause=cause),
            row(f"gain and late {d}", u, (1,), free, -2.4, delay=d, cause=cause),
        ]
    return rows


def markdown(rows: Sequence[Hypothesis]) -> str:
    """Return the rows as a table of Markdown."""
    head = ["hypothesis", "features", "mean", "precision", "log-prior", "forgetting", "bounds"]
    lines = [head, ["---"] * len(head)]
    for row in rows:
        forgetting = f"by distance, {row.nearness:g}" if row.nearness else f"{row.forgetting:g}"
        bounds = "" if math.isinf(row.bounds[0]) else f"{row.bounds[0]:g} to {row.bounds[1]:g}"
        features = ", ".join(f.__name__ if callable(f) else f"`{f}`" for f in row.features)
        features = features.replace("|", r"\|")  # does not end the cell
        mean = ", ".join(f"{value:g}" for value in row.mean)
        precision = ", ".join("known" if p == FIXED else f"{p:g}" for p in row.precision)
        name = row.name + (" (healthy)" if row.healthy else "")
        lines.append([name, features, mean, precision, f"{row.log_prior:g}", forgetting, bounds])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


# Outside the table, because they mix actuators, or are not linear in features (see `core.py`).
MAPS = tuple(Hypothesis(name, (), ()) for name in ("affine", "swapped"))
HELD = tuple(
    Hypothesis(name, (), (), log_prior=log_prior, healthy=True, cause=cause)
    for name, log_prior, cause in (
        ("rate limit", 0.0, "rate limit"),
        ("stiction", -3.0, "stiction"),
        ("changing delay", 0.0, "a changing delay"),
    )
)


class Table(nn.Module):
    """The table as tensors: R rows of up to W coefficients each, over F features.

    H hypotheses are the rows, two maps that mix actuators where there are several, a rate limit,
    stiction, and a changing delay. The first K can be inverted. Effects of all rows are sums of P
    functions of the present command, the *basis*.

    Args:
        rows: the first one is *no fault*.
        action_size: A.
        max_delay: longest delay among the features, steps.
        memory: pairs that are remembered, M.
    """

    def __init__(
        self, rows: Sequence[Hypothesis], action_size: int, max_delay: int, memory: int
    ) -> None:
        super().__init__()
        others = (*(MAPS if action_size > 1 else ()), *HELD)
        every = [*rows, *others]
        self.rows, self.hypotheses = tuple(rows), tuple(every)
        self.names, self.max_delay = tuple(row.name for row in every), max_delay
        self.inverted, self.mixes = len(every) - len(HELD), action_size > 1
        user_functions = dict.fromkeys(f for row in rows for f in row.features if callable(f))
        self.functions: list[Function] = [*user_functions]
        commands = [f"u-{d}" for d in range(max_delay, -1, -1)]
        names: list[Feature] = [*commands, *PAST, *CURVES, "|u|", *user_functions, "1"]
        self._set(**_beliefs(every, max_delay, self.inverted))
        self._set(**_regressors(rows, names, max_delay, len(every)))
        self._set(**_pair_weights(rows, memory))
        self._set(probes=_probes(action_size).mT, grid=torch.linspace(-1, 1, GRID))
        self._set(curve_rates=-torch.tensor([0.0, *CURVES.values()])[:, None])
        self._set(grid_basis=self.basis(self.grid[None]), grid_cost=1e-3 * self.grid.abs())
        self._set(eye=torch.eye(action_size, action_size + 1), axis=torch.arange(action_size))
        self._set(affine_precision=FREE * torch.eye(action_size + 1))
        self._set(least_square_gain=LEAST_GAIN**2 * torch.eye(action_size))
        self._set(lags=torch.arange(memory + 1)[:, None] + torch.arange(max_delay + 1))

    if TYPE_CHECKING:  # its constants are buffers

        def __getattr__(self, name: str) -> Tensor: ...

    def _set(self, **buffers: Tensor) -> None:
        """Keep constants that move with the module, and are not stored with it."""
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)

    def basis(self, u: Tensor) -> Tensor:
        """Return the P functions of commands in which effects are sums, ``(*B, P, C)``.

        Args:
            u: commands, ``(*B, 1, C)``.

        >>> table = Table(hypotheses(), action_size=1, max_delay=8, memory=80)
        >>> table.basis(torch.tensor([[-1.0]])).squeeze(-1)
        tensor([-1.0000, -0.2231, -0.0067,  1.0000,  1.0000])
        """
        size, functions = u.abs(), [f(u) for f in self.functions]
        curves = u * (self.curve_rates * size).exp()
        return torch.cat([curves, size, *functions, torch.ones_like(u)], -2)


def _beliefs(every: Sequence[Hypothesis], max_delay: int, inverted: int) -> dict[str, Tensor]:
    """Return what the belief needs of H hypotheses, of which the first K can be inverted."""
    delays = torch.tensor([row.delay for row in every])
    healthy = torch.tensor([row.healthy for row in every])
    answers = torch.eye(len(every))[:, :inverted]
    answers[healthy] = answers[0]  # all healthy ones have the same answer, the plan
    constant = [k for k, row in enumerate(every) if row.healthy and not k or _only_late(row)]
    return {
        "log_prior": torch.tensor([row.log_prior for row in every[1:]]),  # (H - 1,)
        "loss_range": LOSS_RANGE / (1.0 + (delays > 0)),  # (H,)
        "answers": answers,  # (H, K)
        "has_delay": torch.eye(max_delay + 1)[delays],  # (H, D + 1)
        "constant_delays": torch.tensor(constant),
        "delay_of": delays[:-1],  # (H - 1,)
        "delays": torch.arange(max_delay + 1),
    }


def _only_late(row: Hypothesis) -> bool:
    return row.delay > 0 and row.mean == (1,) and row.precision == (FIXED,)


def _regressors(
    rows: Sequence[Hypothesis], names: Sequence[Feature], max_delay: int, hypotheses: int
) -> dict[str, Tensor]:
    """Return the features of R rows, W each: the last one of a row is in the last column."""
    width, now = max(len(row.features) for row in rows), max_delay
    first_function = max_delay + 1 + len(PAST)

    def padded(values: Sequence[Sequence[float]], fill: float) -> Tensor:
        every = [[*[fill] * (width - len(of)), *of] for of in values]
        return torch.tensor(every, dtype=torch.get_default_dtype())

    index = padded([[names.index(f) for f in row.features] for row in rows], len(names) - 1).long()
    used = padded([[1.0] * len(row.features) for row in rows], 0.0)
    mean = padded([row.mean for row in rows], 0.0)
    # What the present command adds to each feature, by the functions of the basis, (P, F).
    present = torch.eye(len(names))[[now, *range(first_function, len(names))]]
    present[0, names.index("effect")], present[-1] = -1.0, 0.0
    # In which functions a row is a sum, if a late command is inverted when it will act, (R, P, W).
    inverted = present.clone()
    inverted[0, :now] = 1.0
    is_command = (index <= now) | (index >= first_function) & (index < len(names) - 1)
    # While no fault is believed, all H hypotheses expect commands to act as sent, (D + 2, H).
    idle = torch.zeros(max_delay + 2, hypotheses)
    for k, row in enumerate(rows):
        for name, value in zip(row.features, row.mean, strict=True):
            if names.index(name) <= now + 1:
                idle[names.index(name), k] = abs(value)
    idle[now] = torch.where(idle.any(0), idle[now], 1.0)
    curved = [k for k, row in enumerate(rows) if _is_curved(row)]
    effect, maps = (
        torch.full((len(rows), 1, 1), len(names)),
        [False] * (hypotheses - len(rows) - len(HELD)),
    )
    return {
        "index": index,  # (R, W)
        "row_index": index[..., None].clone(),  # branches of a graph must share no storage
        "column_index": torch.cat([index[:, None], effect], -1),  # with the effect, (R, 1, W + 1)
        "mean": mean,
        "mean_of_error": torch.cat([-mean, torch.ones(len(rows), 1)], -1)[..., None],
        "precision": torch.diag_embed(padded([row.precision for row in rows], FIXED)),
        "low": torch.tensor([row.bounds[0] for row in rows])[:, None],  # (R, 1)
        "high": torch.tensor([row.bounds[1] for row in rows])[:, None],
        "feature_variance": torch.tensor([row.feature_variance for row in rows])[:, None],
        "shared": torch.tensor([row.shared for row in rows])[:, None, None],
        "present": present,
        "of_command": (used * inverted[:, index]).transpose(0, 1),  # (R, P, W)
        "of_past": used * ~is_command,  # (R, W)
        "is_effect": index == names.index("effect"),  # (R, W)
        "effect": torch.tensor([names.index("effect")]),
        "known": (present <= 0).all(0).to(present),  # before the command is chosen, (F,)
        "idle": idle,
        "curved": torch.tensor(curved),
        "linear": torch.tensor([k not in curved for k in range(len(rows))] + maps),  # (K,)
        "row_delays": torch.tensor([row.delay for row in rows]),
        "lagging": torch.tensor(["effect" in row.features for row in rows] + maps).to(mean),
    }


def _is_curved(row: Hypothesis) -> bool:
    return any(callable(feature) or feature in (*CURVES, "|u|") for feature in row.features)


def _pair_weights(rows: Sequence[Hypothesis], memory: int) -> dict[str, Tensor]:
    """Return the G ways in which rows weigh M pairs: by age, or by distance and age."""
    age = torch.arange(memory - 1, -1, -1)
    forgetting = sorted({row.forgetting for row in rows if not row.nearness})
    nearness = sorted({row.nearness for row in rows if row.nearness})
    group = [
        len(forgetting) + nearness.index(row.nearness)
        if row.nearness
        else forgetting.index(row.forgetting)
        for row in rows
    ]
    back = torch.arange(memory + 1) - torch.arange(memory)[:, None]  # how much later, steps
    return {
        "group": torch.tensor(group)[:, None, None],  # (R, 1, 1)
        "decay": torch.tensor(forgetting)[:, None] ** age,  # (G, M)
        "nearness": torch.tensor(nearness)[:, None],
        "distance_of_age": (age / STEPS_AS_DISTANCE).square(),
        "smoothing": torch.where(back > 0, -(SENSOR_SMOOTHING**back), 0.0),  # (M, M + 1)
        "age": torch.arange(memory, -1, -1) / 10,
        "is_before_newest": torch.arange(memory) < memory - 1,
    }


def _probes(action_size: int) -> Tensor:
    """Return commands ``(C, A)`` from all over the box: both ends of all axes, and points between.

    >>> _probes(1)[:2].tolist()
    [[1.0], [-1.0]]
    """
    ends = torch.cat([torch.eye(action_size), -torch.eye(action_size)])
    inner = torch.quasirandom.SobolEngine(action_size).draw(max(1, PROBES - 2 * action_size))
    return torch.cat([ends, 2 * inner - 1])
