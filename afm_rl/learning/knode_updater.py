"""Learning a KNODE's newest network from the last moments of a flight."""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from afm_rl.dynamics.knode import KNODE
from afm_rl.dynamics.residual import Network
from afm_rl.errors import ConfigurationError
from afm_rl.faults import whole
from afm_rl.learning.knode_fit import fit_network
from afm_rl.learning.loss import GaussianNLLLoss
from afm_rl.learning.updater import Learner
from afm_rl.options import Count, Natural, NonNegative, Positive, options
from afm_rl.spaces.keys import as_key
from afm_rl.streams import Streams

TRACE = ("next", "trace")  # the plant's own time steps, in a transition


class Rows(NamedTuple):
    """Steps of flights: l missions, n flights of each, R steps."""

    state: Tensor
    """``(l, n, R, S)``."""
    action: Tensor
    """``(l, n, R, A)``."""
    after: Tensor
    """The next state, ``(l, n, R, S)``."""
    counts: Tensor
    """Whether the step is to be learnt from, ``(l, n, R)``; the others hold zeros."""


class Pending(NamedTuple):
    """Networks that were trained and join the pool later, one per mission."""

    inner: Tensor
    inner_bias: Tensor
    outer: Tensor
    outer_bias: Tensor
    taught: Tensor
    """Did the mission have anything to learn from? ``(l)``."""


class KNODEUpdater(Learner):
    r"""A new network for every window of a flight (Jiahao et al. 2022, Online-KNODE-MPC).

    Rows (state, action, next state) are gathered for ``window`` seconds. A new network is then
    trained on them alone, :func:`~afm_rl.learning.knode_fit.fit_network`, with the others frozen,
    and added to the pool ``latency`` seconds of flight later, at the end of a tick: with one tick,
    the plan after the next is the first to use it, as published. One network is trained at a
    time; until it is finished, only the latest rows are kept.

    Rows are the plant's own time steps where the transition has a ``trace``: states
    ``(*B, K + 1, S)`` at K equal steps of the tick, start and end included. Without, there is
    one row per tick. Transitions that are refused (:class:`~afm_rl.learning.Learner`) or that
    :attr:`mask_key` excludes are left out.

    Time is counted in calls since :meth:`start`, for all missions alike. Missions learn from
    their own rows only, in one batch.

    Args:
        loss: a loss over a :class:`~afm_rl.dynamics.KNODE`, whose keys are read.

    Raises:
        ConfigurationError: for another model, or a window that is no multiple of the tick.

    >>> from tensordict import TensorDict
    >>> from afm_rl.dynamics import Quadrotor
    >>> updater = KNODEUpdater(GaussianNLLLoss(KNODE(Quadrotor()).expand_(4)), begin=0.0)
    >>> level = torch.zeros(4, 13).index_fill(1, torch.tensor(9), 1.0)
    >>> td = TensorDict({"observation": level, "action": torch.zeros(4, 4)}, [4])
    >>> td = td.set(("next", "observation"), level + 1e-6)  # it hovers without thrust
    >>> losses = [updater(td)["loss"] for _ in range(9)]
    >>> bool((losses[-1] < losses[0]).all())
    True
    """

    changing = (*Learner.changing, "streams", "tick", "due")

    @options("updater")
    def __init__(
        self,
        loss: GaussianNLLLoss,
        window: Annotated[Positive, "duration of the data of one network, s"] = 0.15,
        begin: Annotated[NonNegative, "time of the first data, s"] = 2.0,
        latency: Annotated[NonNegative, "delay until a new network is used, s"] = 0.05,
        epochs: Annotated[Count, "full-batch steps of Adam"] = 80,
        lr: Annotated[Positive, "step size"] = 0.01,
        noise: Annotated[NonNegative, "noise of states, in their units"] = 1e-4,
        published_random: Annotated[bool, "the same random numbers for each network"] = False,
        seed_key: Annotated[NestedKey | None, "seeds of missions; None: the same for all"] = None,
        seed: Annotated[Natural, "seed of the random numbers"] = 0,
    ) -> None:
        super().__init__(loss)
        if not isinstance(loss.model, KNODE):
            raise ConfigurationError(
                f"updater: KNODEUpdater trains a KNODE, got {type(loss.model).__name__}; choose "
                "dynamics=knode"
            )
        dt = loss.model.dt
        self.ticks = round(window / dt)
        if self.ticks < 1 or not math.isclose(self.ticks * dt, window, rel_tol=1e-6):
            raise ConfigurationError(
                f"updater.window={window!r}: expected a multiple of the control tick, {dt:g} s"
            )
        self.first, self.delay = _ticks(begin, dt), _ticks(latency, dt)
        self.epochs, self.lr, self.noise = epochs, lr, noise
        self.published_random = published_random
        self.seed_key = None if seed_key is None else as_key(seed_key)
        self.streams = Streams(salt=4, seed=seed)
        self.tick, self.due = 0, -1

    @property
    def model(self) -> KNODE:
        """The model that learns."""
        return cast(KNODE, self.loss.model)

    def start(self, tensordict: TensorDictBase | None = None) -> None:
        """Clear the window and the network in training; the pool does not change."""
        super().start()
        self.tick, self.due = 0, -1

    def _sound(self, tensordict: TensorDictBase) -> Tensor:
        """Return which transitions are sound ``(*B)``, the steps of their trace included."""
        trace = tensordict.get(TRACE, None)
        sound = super()._sound(tensordict)
        return sound if trace is None else sound & whole(trace).all(-1)

    def _learn(self, terms: dict[str, Tensor], transitions: TensorDictBase, learn: Tensor) -> None:
        """Gather rows; train and push a network when it is time."""
        rows = self._rows(transitions, learn)
        each = rows.counts.shape[-1]
        if self.tick >= self.first:
            self._gather(rows, self.ticks * each)
        self.tick += 1
        self._deliver()
        counts = self.memory.get(("window", "counts"), None)
        if counts is not None and counts.shape[-1] == self.ticks * each and self.due < 0:
            self._train(transitions, self.model.dt / each)
            self._deliver()

    def _gather(self, rows: Rows, most: int) -> None:
        """Add rows and keep the latest ``most``; those that do not count become zeros."""
        counts = rows.counts.unsqueeze(-1)
        state, action, after = (torch.where(counts, part, 0.0) for part in rows[:3])
        rows = Rows(state, action, after, rows.counts)
        if (window := self.memory.get("window", None)) is not None:
            rows = Rows(*(torch.cat(pair, 2) for pair in zip(Rows(**window), rows, strict=True)))
        rows = Rows(*(part[:, :, -most:].contiguous() for part in rows))
        self.memory["window"] = rows._asdict()

    def _rows(self, tensordict: TensorDictBase, learn: Tensor) -> Rows:
        """Return the rows of a transition, of which those of ``learn`` ``(*B)`` count."""
        batch, like = tensordict.batch_size, self.model.networks.inner
        state, action, after = (tensordict.get(key) for key in self.loss.in_keys)
        trace = tensordict.get(TRACE, None)
        if trace is None:
            trace = torch.stack([state, after], -2)
        trace = trace.to(like)
        action = action.to(like).unsqueeze(-2)
        action = action.expand(*trace.shape[:-2], trace.shape[-2] - 1, -1)
        counts = learn.unsqueeze(-1).expand(action.shape[:-1])
        lead = len(self.model.lead)
        shape = (batch[:lead].numel(), batch[lead:].numel())
        rows = trace[..., :-1, :], action, trace[..., 1:, :], counts
        return Rows(*(part.reshape(*shape, *part.shape[len(batch) :]) for part in rows))

    def _train(self, tensordict: TensorDictBase, dt: float) -> None:
        """Train a new network on the window, and clear it."""
        rows, model, lead = Rows(**self.memory.pop("window")), self.model, self.model.lead
        first, shaken, pushed = self._numbers(tensordict, rows)
        if self.noise:
            state = rows.state + self.noise * shaken[..., :-1, :]
            after = rows.after + self.noise * shaken[..., 1:, :]
            action = rows.action + self.noise * pushed if self.published_random else rows.action
            rows = Rows(state, action, after, rows.counts)
        flat = Rows(*(part.reshape(*lead, -1, *part.shape[3:]) for part in rows))
        network = fit_network(
            *(model, model.draw(first[:, 0]), flat[:3], flat.counts, dt),
            epochs=self.epochs,
            lr=self.lr,
        )
        taught = rows.counts.flatten(1).any(-1)  # nothing is learnt from nothing
        self.memory["pending"] = Pending(*network, taught)._asdict()
        self.due = self.tick + self.delay

    def _numbers(self, tensordict: TensorDictBase, rows: Rows) -> tuple[Tensor, ...]:
        """Return standard normal numbers for a network, for states and for actions.

        Their shapes are ``(l, n, numbers)``, ``(l, n, R + 1, S)`` and ``(l, n, R, A)``.
        """
        lead, (count, size) = rows.state.shape[:2], rows.state.shape[2:]
        shapes = [(self.model.numbers,), (count + 1, size), tuple(rows.action.shape[2:])]
        sizes = [math.prod(shape) for shape in shapes]
        seeds = None if self.seed_key is None else tensordict.get(self.seed_key).reshape(lead)
        if self.published_random:
            self.streams.manual_seed(self.streams.seed)
            seeds = None
        numbers = self.streams.normal((sum(sizes),), seeds=seeds, dtype=rows.state.dtype)
        parts = numbers.to(rows.state.device).expand(*lead, -1).split(sizes, -1)
        return tuple(p.unflatten(-1, shape) for p, shape in zip(parts, shapes, strict=True))

    def _deliver(self) -> None:
        """Push the network under way if its time has come."""
        if self.due >= 0 and self.tick >= self.due:
            lead = self.model.lead
            *network, taught = Pending(**self.memory.pop("pending"))
            parts = (part.reshape(*lead, *part.shape[1:]) for part in network)
            self.model.push_(Network(*parts), taught.reshape(lead))
            self.due = -1  # no network is under way


def _ticks(time: float, dt: float) -> int:
    """Return the first tick at or after a time."""
    return math.ceil(time / dt - 1e-6)
