"""Pre-training of an ensemble on samples of another model."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.compiling.devices import device_of
from afm_rl.dynamics import DynamicsModel, Ensemble
from afm_rl.errors import check_count, check_number
from afm_rl.learning.fitting import FitReport, fit_changes
from afm_rl.spaces.manifold import uniform


def pretrain_ensemble(
    model: Ensemble,
    teacher: DynamicsModel,
    state_box: tuple[Tensor, Tensor],
    action_box: tuple[Tensor, Tensor],
    *,
    samples: int = 50_000,
    epochs: int = 16,
    batch_size: int = 256,
    lr: float = 2e-3,
    action_noise: float = 0.0,
    seed: int = 0,
    names: Sequence[str] | None = None,
    progress: bool = False,
) -> FitReport:
    """Fit an ensemble to a teacher by Gaussian NLL; return its held-out errors.

    States and actions are drawn uniformly from their boxes; each member sees the batches in
    an order of its own. Adam with a one-cycle step size, best epoch kept.

    Args:
        model: ensemble to fit, in place; its normaliser is set from the data.
        teacher: model that gives the next states.
        state_box: lowest and highest state, ``(S,)`` each.
        action_box: lowest and highest action, ``(A,)`` each.
        samples: size of the training set; a tenth as many are held out.
        epochs: passes over the data.
        batch_size: samples per step and member.
        lr: largest step size.
        action_noise: relative perturbation of the teacher's action, 0.1 for +-10 %
            (domain randomisation).
        seed: seed of data and order.
        names: of the coordinates of the tangent space, for the warning.
        progress: show progress.

    Warns:
        UserWarning: if more than a third of the variance of a coordinate is left unexplained.
    """
    check_count("dynamics.pretrain.batch_size", batch_size)
    check_count("dynamics.pretrain.samples", samples, low=batch_size)
    check_count("dynamics.pretrain.epochs", epochs)
    check_number("dynamics.pretrain.lr", lr, low=0.0, open_low=True)
    check_number("dynamics.pretrain.action_noise", action_noise, low=0.0)
    generator, device = torch.Generator().manual_seed(seed), device_of(model)
    total = samples + samples // 10
    low, high, lowest, highest = (end.to(device) for end in (*state_box, *action_box))
    state = teacher.manifold.project(uniform(low, high, total, generator))
    action = uniform(lowest, highest, total, generator)
    factor = 1 + action_noise * (2 * torch.rand(action.shape, generator=generator) - 1)
    factor = factor.to(device)
    with torch.no_grad():
        change = teacher.manifold.difference(teacher(state, action * factor), state)
    return fit_changes(
        model,
        state,
        action,
        change,
        samples=samples,
        epochs=epochs,
        batch_size=batch_size,
        lr=lr,
        generator=generator,
        title="pre-training the ensemble",
        names=names,
        progress=progress,
    )
