"""Robots whose actions do not have the effects that were planned."""

import pytest
import torch

from afm_rl.correction import Correction
from afm_rl.dynamics import KnownDynamics
from afm_rl.spaces.manifold import Manifold


def push(state, action):
    return state + action


class Line(KnownDynamics):
    """A point that moves by its action: s' = s + a, in any number of dimensions."""

    affine = True

    def jacobian(self, state, action):
        eye = torch.eye(self.action_size, dtype=action.dtype, device=action.device)
        return eye.expand(*action.shape, -1)


@pytest.fixture
def line():
    """Make the model of a point in some dimensions."""
    return lambda size, noise_std=1e-3: Line(push, Manifold(size), size, noise_std)


@pytest.fixture
def drive():
    """Let a corrector drive a robot; return all corrections and the actions' effects.

    The last memory is ``drive.memory``.
    """

    def run(corrector, model, effect, plans, state=None, noise=0.0):
        """``effect(executed so far)`` is of the last one; plans are ``(T, *B, A)``."""
        batch, size = plans.shape[1:-1], plans.shape[-1]
        low = corrector.denormalise(corrector.lowest).expand(*batch, size)
        high = corrector.denormalise(corrector.highest).expand(*batch, size)
        box = torch.stack([low, high], -2).to(plans)
        state = plans.new_zeros(*batch, model.state_size) if state is None else state
        memory, found, sent, effects = corrector.begin(state), [], [], []
        for plan in plans:
            memory, correction = corrector.correct(memory, plan, model, box)
            sent.append(correction.executed_action)
            effects.append(effect(sent))
            state = model(state, effects[-1])
            state = state + noise * torch.randn_like(state)
            memory = corrector.observe(memory, state)
            found.append(correction)
        filled = (part for part in zip(*found, strict=True) if part[0] is not None)
        every, run.memory = Correction(*map(torch.stack, filled)), memory
        return every, torch.stack(effects)

    return run


@pytest.fixture
def plans():
    """Make plans ``(T, *B, A)`` in some part of the unit box."""

    def make(*shape, seed=0, size=0.6):
        generator = torch.Generator().manual_seed(seed)
        return size * (2 * torch.rand(*shape, generator=generator) - 1)

    return make
