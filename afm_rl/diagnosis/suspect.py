"""Do the steps of a robot that should be healthy look like a fault of its actuators?"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.dynamics.base import DynamicsModel
from afm_rl.spaces.manifold import Manifold

LONGEST = 6  # largest delay that is estimated, steps
OFFSET = 0.2  # share of the largest action
PART = 25  # steps: a fault may have begun within the window
FEWEST = 8  # steps of which something is said
LEAST_GAIN, DEVIATIONS = 0.15, 3.0


class FaultTable(NamedTuple):
    """H usual faults of A actuators; the first row is no fault.

    .. math:: u' = h + M (u_{t - d} - h) + b
    """

    words: list[str]
    delay: Tensor
    """d, in steps, ``(H,)``."""
    matrix: Tensor
    """M, ``(H, A, A)``."""
    offset: Tensor
    """b, ``(H, A)``."""
    home: Tensor
    """h, the neutral action, ``(A,)``."""

    @classmethod
    def of(
        cls, largest: Tensor, home: Tensor | None = None, names: Sequence[str] = ()
    ) -> FaultTable:
        """Return the table: delays, reversed, weak, dead and swapped actuators, and offsets.

        Args:
            largest: sizes of the largest actions, ``(A,)``.
            home: neutral action, ``(A,)``; None: zero.
            names: of the actuators; numbers if none.

        >>> table = FaultTable.of(torch.ones(2))
        >>> len(table.words), table.words[3], table.words[-1]
        (23, '3 steps late', 'actuators 0 and 1 swapped')
        """
        size, none = len(largest), torch.zeros_like(largest)
        same, rows = torch.eye(size).to(largest), list[tuple[str, int, Tensor, Tensor]]()
        rows.append(("", 0, same, none))
        for k in range(1, LONGEST + 1):
            rows.append((f"{k} step{'s' * (k > 1)} late", k, same, none))
        each = [("all", torch.ones_like(largest))]
        each += [(names[j] if names else f"actuator {j}", same[j]) for j in range(size)]
        for name, which in each if size > 1 else each[1:]:
            for kind, gain in (("reversed", -1.0), ("at half", 0.5), ("dead", 0.0)):
                rows.append((f"{name} {kind}", 0, (1 + (gain - 1) * which).diag(), none))
            for sign in (1, -1):
                kind = f"{name} with an offset of {100 * sign * OFFSET:+.0f} %"
                rows.append((kind, 0, same, sign * OFFSET * largest * which))
        for i, j in combinations(range(size), 2):
            order = list(range(size))
            order[i], order[j] = j, i
            both = f"{names[i]} and {names[j]}" if names else f"actuators {i} and {j}"
            rows.append((f"{both} swapped", 0, same[order], none))
        words, delay, matrix, offset = zip(*rows, strict=True)
        home = none if home is None else home.to(largest)
        parts = torch.tensor(delay, device=largest.device), torch.stack(matrix)
        return cls([*words], *parts, torch.stack(offset), home)

    def acted(self, sent: Tensor) -> Tensor:
        """Return what would have acted, ``(*B, H, A)``.

        Args:
            sent: the present action, then those of 1 to 6 steps before, ``(*B, 7, A)``; NaN where
                it is not known.
        """
        about = (sent - self.home).index_select(-2, self.delay).unsqueeze(-1)
        return self.home + (self.matrix @ about).squeeze(-1) + self.offset

    def predicted(self, model: DynamicsModel, state: Tensor, sent: Tensor) -> Tensor:
        """Return the next states that a model predicts, ``(*B, H, S)``; NaN if not known."""
        acted = self.acted(sent)
        known = acted.isfinite().all(-1, keepdim=True)
        wide = state.unsqueeze(-2).expand(*acted.shape[:-1], -1)
        return torch.where(known, model(wide, acted.nan_to_num()), torch.nan)

    def part(self, rows: Sequence[int]) -> FaultTable:
        """Return some rows of the table."""
        words, at = [self.words[k] for k in rows], list(rows)
        return FaultTable(words, self.delay[at], self.matrix[at], self.offset[at], self.home)


def likely_fault(errors: Tensor, floor: Tensor) -> Tensor:
    r"""Return which row of the table explains steps of robots better than none, ``(L)``; else 0.

    .. math:: \frac1D \sum_d \log \frac{\overline{e_d^2}}{\overline{e_d'^2}}
              > .15 + 3 \sqrt{\frac{2}{n D}}

    with e and e' the errors of n steps without and with the fault: of all steps, or of any 25 of
    them in a row. The coordinates count alike, because each has a noise of its own.

    Args:
        errors: squared, ``(L, N, H, D)``, the first row without a fault; NaN where not known.
        floor: squared errors that are the same as none, ``(L, D)``.

    >>> errors = torch.tensor([1.0, 0.1]).reshape(1, 1, 2, 1).expand(1, 30, 2, 1)
    >>> likely_fault(errors, torch.zeros(1, 1))
    tensor([1])
    """
    steps, floor = errors.shape[1], floor.unsqueeze(-2)
    known = errors.isfinite().all(-1, keepdim=True)
    best = errors.new_zeros(len(errors))
    cause = torch.zeros_like(best, dtype=torch.long)
    parts = [(0, steps), *((k, k + PART) for k in range(0, steps - PART + 1, PART))]
    for begin, end in parts:
        own, seen = errors[:, begin:end], known[:, begin:end]
        seen = seen & seen[:, :, :1]
        count = seen.sum(1)
        with_fault = torch.where(seen, own, 0.0).sum(1) / count + floor
        without = torch.where(seen, own[:, :, :1], 0.0).sum(1) / count + floor
        gain = (without / with_fault).log().mean(-1)
        gain -= LEAST_GAIN + DEVIATIONS * (2 / (count.squeeze(-1) * own.shape[-1])).sqrt()
        gain = torch.where((count.squeeze(-1) >= FEWEST) & gain.isfinite(), gain, 0.0)
        most, which = gain.max(-1)
        cause, best = torch.where(most > best, which, cause), best.maximum(most)
    return cause


@torch.no_grad()
def suspect(
    model: DynamicsModel,
    state: Tensor,
    action: Tensor,
    after: Tensor,
    names: Sequence[str] = (),
    most: int = 300,
) -> str:
    """Return which usual fault explains N steps better than none, in words; empty if none does.

    It knows delays of up to 6 steps, and actuators that are reversed, at half, dead, swapped, or
    have an offset of a fifth of the largest action. It does not see smaller gains and offsets.

    Args:
        model: the nominal model.
        state, after: ``(N, S)``, in the order of time.
        action: the actions that were executed, ``(N, A)``.
        names: of the actuators.
        most: steps that are looked at; of more, parts that are evenly spread.

    >>> from afm_rl.dynamics import Dubins
    >>> s, a = torch.zeros(50, 3), torch.linspace(-1, 1, 100).sin().reshape(50, 2)
    >>> suspect(Dubins(), s, a, Dubins()(s, a.flip(-1)))
    'actuators 0 and 1 swapped'
    """
    sent = history(state, action, after, LONGEST)
    if len(state) > most:
        starts = torch.linspace(0, len(state) - PART, most // PART).long()
        rows = (starts.unsqueeze(-1) + torch.arange(PART)).flatten()
        state, sent, after = state[rows], sent[rows], after[rows]
    table = FaultTable.of(sent[:, 0].abs().amax(0).clamp_min(1e-9), model.home, names)
    predicted = table.predicted(model, state, sent)
    after_all = after.unsqueeze(-2).expand_as(predicted)
    errors = model.manifold.difference(after_all, predicted).square()
    floor = floor_of(model.manifold, state, after)
    return table.words[int(likely_fault(errors.unsqueeze(0), floor.unsqueeze(0)))]


def history(state: Tensor, action: Tensor, after: Tensor, steps: int) -> Tensor:
    """Return the action of each of N steps, then those of 1 to ``steps`` before, ``(N, 1 + K, A)``.

    NaN where a step does not follow the one before.
    """
    row = torch.arange(len(action), device=action.device)
    back = torch.arange(steps + 1, device=action.device)
    sent = action[(row.unsqueeze(-1) - back).clamp_min(0)]
    known = ages(state, after).unsqueeze(-1) >= back
    return sent.where(known.unsqueeze(-1), torch.nan)


def ages(state: Tensor, after: Tensor) -> Tensor:
    """Return how many of the steps before each one lead to it without a gap, ``(N,)``.

    >>> s = torch.tensor([[0.0], [1.0], [2.0], [7.0]])
    >>> ages(s, s + 1)
    tensor([0, 1, 2, 0])
    """
    row = torch.arange(len(state), device=state.device)
    begins = torch.ones_like(row, dtype=torch.bool)
    begins[1:] = (state[1:] != after[:-1]).any(-1)
    return row - torch.where(begins, row, 0).cummax(0).values


def floor_of(manifold: Manifold, state: Tensor, after: Tensor) -> Tensor:
    """Return squared errors ``(*L, D)`` that are the same as none, of steps ``(*L, N, S)``."""
    motion = manifold.difference(after, state)
    return 1e-6 * motion.square().mean(-2) + 1e-18
