"""Fitting of an ensemble to transitions, whoever made them."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from tqdm.auto import tqdm

from afm_rl.dynamics import Ensemble
from afm_rl.errors import NonFiniteError, check_count, check_number
from afm_rl.keys import as_keys
from afm_rl.learning.nll import gaussian_nll

CONSTANT = 1e-8  # a coordinate that varies less never changes


def fit_ensemble(
    model: Ensemble,
    transitions: TensorDictBase,
    *,
    epochs: int = 40,
    batch_size: int = 256,
    lr: float = 2e-3,
    held_out: float = 0.1,
    keys: tuple[NestedKey, NestedKey, NestedKey] = (
        "observation",
        "action",
        ("next", "observation"),
    ),
    seed: int = 0,
    progress: bool = False,
) -> float:
    """Fit an ensemble to observed transitions by Gaussian NLL; return its held-out error.

    Each member sees the batches in an order of its own. Adam with a one-cycle step size, best
    epoch kept.

    Args:
        model: ensemble to fit, in place; its normaliser is set from the data.
        transitions: any batch shape, N in all; see :func:`~afm_rl.learning.collect`.
        epochs: passes over the data.
        batch_size: transitions per step and member, at most.
        lr: largest step size.
        held_out: share of the transitions, picked at random, that only judges.
        keys: where state, action and next state are.
        seed: seed of the order.
        progress: show a progress bar.

    Returns:
        Root mean square of the held-out one-step error in standard deviations of the data.

    Raises:
        NonFiniteError: if an entry is not finite.

    >>> from tensordict import TensorDict
    >>> from afm_rl.manifold import Manifold
    >>> entries = {"observation": torch.randn(400, 1), "action": torch.randn(400, 1)}
    >>> cart = TensorDict(entries, [400])
    >>> cart["next", "observation"] = cart["observation"] + 0.1 * cart["action"]
    >>> model = Ensemble(Manifold(1), 1, features=[0], members=2, hidden=[8])
    >>> fit_ensemble(model, cart, lr=2e-2, batch_size=32) < 0.2
    True
    """
    check_number("held_out", held_out, low=0.0, high=0.5, open_low=True)
    state, action, after = (transitions.get(key).flatten(0, -2) for key in as_keys(keys))
    for key, value in zip(keys, (state, action, after), strict=True):
        if not bool(value.isfinite().all()):
            raise NonFiniteError(f"transitions: {key!r} holds numbers that are not finite")
    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(state), generator=generator)
    state, action, after = state[order], action[order], after[order]
    change = model.manifold.difference(after, state)
    samples = check_count("transitions", len(state), low=2) - max(1, round(held_out * len(state)))
    return fit_changes(
        model,
        state,
        action,
        change,
        samples=samples,
        epochs=check_count("epochs", epochs),
        batch_size=min(check_count("batch_size", batch_size), samples),
        lr=check_number("lr", lr, low=0.0, open_low=True),
        generator=generator,
        title="fitting the ensemble",
        progress=progress,
    )


def fit_changes(
    model: Ensemble,
    state: Tensor,
    action: Tensor,
    change: Tensor,
    *,
    samples: int,
    epochs: int,
    batch_size: int,
    lr: float,
    generator: torch.Generator,
    title: str,
    progress: bool,
) -> float:
    """Fit to state changes ``(N, D)``, of which all but the first ``samples`` are held out."""
    model.normalise_(model.inputs(state, action)[:samples], change[:samples])
    # What never changes would else be predicted to within rounding, and any error surprise.
    model.target_std.masked_fill_(model.target_std <= CONSTANT, 1.0)
    target = model.standardise(change)
    optimizer = torch.optim.Adam(model.parameters(), lr=lr, fused=True)
    steps = samples // batch_size
    cycle = torch.optim.lr_scheduler.OneCycleLR(optimizer, lr, total_steps=steps * epochs)
    best, kept = float("inf"), None
    bar = tqdm(total=steps * epochs, desc=title, disable=None if progress else True)
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
