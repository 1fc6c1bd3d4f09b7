"""Windows, and lives of robots, that flows look at."""

import pytest
import torch

from afm_rl.dynamics import Dubins
from afm_rl.flow import Context, ContextFlow, Window

TINY = {"window": 4, "memory": 9, "hidden": [16], "latent": 8}


class Fitted(ContextFlow):
    """Knows what actions are worth from one of its least-squares fits: exact, and not trained."""

    fit = 1  # the gain with long memory

    def effect(self, known, executed):
        return known.fits.effect(executed).unflatten(-1, (-1, self.action_size))[..., self.fit, :]


@pytest.fixture
def flow(box):
    return ContextFlow(*box, **TINY)


@pytest.fixture
def fitted(box):
    """Make a flow whose effect is a fit."""

    def make(fit=1, **settings):
        flow = Fitted(*box, **{**TINY, **settings})
        flow.fit = fit
        return flow

    return make


@pytest.fixture
def window_of(transitions):
    """Make a full window of transitions under a gain."""

    def make(gain, *batch, rows=9):
        state, action = transitions(*batch, rows)
        reached = Dubins()(state, action * torch.as_tensor(gain))
        valid = torch.ones(*batch, rows, dtype=torch.bool)
        return Window(state, action, action, reached, valid)

    return make


@pytest.fixture
def told():
    """Make the context of a misaligned model from features alone."""

    def make(corrector, features):
        if hasattr(corrector, "told"):
            return corrector.told(features)
        size, none = features[..., 0], features[..., :0]
        return Context(none, none, features, size, size.bool())

    return make


def contexts_of(flow, state, executed, next_state, model=None, valid=None):
    """Return the contexts of a mission ``(*B, T, ...)`` after each of its steps."""
    rows, last = flow.window, None
    if valid is None:
        valid = torch.ones(state.shape[:-1], dtype=torch.bool)

    def late(part):
        blank = torch.zeros_like(part[..., :1, :]).expand(*part.shape[:-2], rows, part.shape[-1])
        return torch.cat([blank, part], -2)

    parts = [late(part) for part in (state, executed, executed, next_state)]
    counts = late(valid.unsqueeze(-1)).squeeze(-1)
    found = []
    for end in range(1, state.shape[-2] + 1):
        seen = (part[..., end : end + rows, :] for part in parts)
        window = Window(*seen, counts[..., end : end + rows])
        last = flow.context(window, model or Dubins(), last)
        found.append(last)
    return found


@pytest.fixture
def live():
    """Let a flow watch a mission."""
    return contexts_of


@pytest.fixture
def shown(told):
    """Make the context of pairs (executed, effective action), ``(*B, K, A)``."""

    def make(corrector, executed, effective, valid=None):
        count = torch.ones_like(executed[..., :1]) if valid is None else valid.unsqueeze(-1)
        pairs = [corrector.normalise(executed), corrector.normalise(effective)]
        rows = torch.cat([*pairs, torch.ones_like(executed[..., :1])], -1)
        return told(corrector, (rows * count).flatten(-2))

    return make


@pytest.fixture
def unknown():
    """Make the context of a corrector that has seen nothing, as a reset leaves it."""

    def make(corrector, *batch):
        pairs = torch.zeros(*batch, corrector.window, corrector.pair_size)
        evidence = torch.zeros(*batch, corrector.evidence_size)
        features, silent = torch.zeros(*batch, corrector.context_size), torch.zeros(batch)
        return Context(pairs, evidence, features, silent, silent.bool())

    return make
