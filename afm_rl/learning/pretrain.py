"""Pre-training of an ensemble on samples of another model."""

from __future__ import annotations

import torch
from torch import Tensor
from tqdm.auto import tqdm

from afm_rl.dynamics import DynamicsModel, Ensemble
from afm_rl.errors import check_count, check_number
from afm_rl.learning.nll import gaussian_nll
from afm_rl.sampling import uniform


def pretrain_ensemble(
    model: Ensemble,
    teacher: DynamicsModel,
    state_box: tuple[Tensor, Tensor],
    action_box: tuple[Tensor, Tensor],
    *,
    samples: int = 50_000,
    epochs: int = 10,
    batch_size: int = 256,
    lr: float = 2e-3,
    action_noise: float = 0.0,
    seed: int = 0,
    progress: bool = False,
) -> float:
    """Fit an ensemble to a teacher by Gaussian NLL; return its held-out error.

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
        progress: show a progress bar.

    Returns:
        Root mean square of the held-out one-step error in standard deviations of the data.
    """
    check_count("dynamics.pretrain.batch_size", batch_size)
    check_count("dynamics.pretrain.samples", samples, low=batch_size)
    check_count("dynamics.pretrain.epochs", epochs)
    check_number("dynamics.pretrain.lr", lr, low=0.0, open_low=True)
    check_number("dynamics.pretrain.action_noise", action_noise, low=0.0)
    generator = torch.Generator().manual_seed(seed)
    total = samples + samples // 10
    state = teacher.manifold.project(uniform(*state_box, total, generator))
    action = uniform(*action_box, total, generator)
    factor = 1 + action_noise * (2 * torch.rand(action.shape, generator=generator) - 1)
    with torch.no_grad():
        change = teacher.manifold.difference(teacher(state, action * factor), state)
    model.normalise_(model.inputs(state, action)[:samples], change[:samples])
    target = model.standardise(change)
    optimizer = torch.optim.Adam(model.parameters(), lr=lr, fused=True)
    steps = samples // batch_size
    cycle = torch.optim.lr_scheduler.OneCycleLR(optimizer, lr, total_steps=steps * epochs)
    best, kept = float("inf"), None
    bar = tqdm(
        total=steps * epochs, desc="pre-training the ensemble", disable=None if progress else True
    )
    with bar, torch.enable_grad():
        for _ in range(epochs):
            order = torch.rand(model.members, samples, generator=generator).argsort(-1)
            for rows in order[:, : steps * batch_size].split(batch_size, -1):
                loss = _member_nll(model, state, action, target, rows)
                optimizer.zero_grad(set_to_none=True)
                loss.backward()
                optimizer.step()
                cycle.step()
                bar.update()
            error = held_out_error(model, state[samples:], action[samples:], target[samples:])
            bar.set_postfix(held_out=f"{error:.4f}")
            if error < best:
                best, kept = error, {k: v.clone() for k, v in model.state_dict().items()}
    if kept is not None:
        model.load_state_dict(kept)
    return best


def _member_nll(
    model: Ensemble, state: Tensor, action: Tensor, target: Tensor, rows: Tensor
) -> Tensor:
    """Return the loss, each member ``e`` on its own samples ``rows[e]``."""
    mean, log_variance = model.member_moments(state[rows], action[rows])
    return gaussian_nll(mean, log_variance, target[rows]).mean((-2, -1)).sum()


@torch.no_grad()
def held_out_error(model: Ensemble, state: Tensor, action: Tensor, target: Tensor) -> float:
    """Return the RMSE of the members' mean in standardised units."""
    mean, _ = model.moments(state, action)
    return float((mean.mean(-2) - target).square().mean().sqrt())
