"""Fitting of an ensemble, to recorded transitions or to samples of another model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Le
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from afm_rl.compiling.devices import device_of
from afm_rl.dynamics import DynamicsModel, Ensemble
from afm_rl.errors import NonFiniteError, check_count, warn
from afm_rl.learning.collect import TRANSITION
from afm_rl.learning.loss import gaussian_nll
from afm_rl.options import Count, Natural, NonNegative, Positive, Share, options
from afm_rl.progress import Bar
from afm_rl.spaces.keys import as_keys
from afm_rl.spaces.manifold import uniform

HELD_OUT = 0.1  # share of transitions that only judges


@dataclass(frozen=True)
class FitReport:
    """What a fitted model misses on held-out transitions, one step ahead."""

    error: float
    """Root mean square over coordinates, in standard deviations of the data."""
    rms: tuple[float, ...]
    """Root mean square of each coordinate of the state change, in its own unit."""
    unexplained: tuple[float, ...]
    """Share of each coordinate's variance that is left: 0 is perfect, 1 is as good as the mean."""
    names: tuple[str, ...] = ()
    """Of the coordinates."""

    @classmethod
    def of(
        cls, model: Ensemble, error: Tensor, variance: Tensor, names: Sequence[str] | None
    ) -> FitReport:
        """Return the report of mean squared errors ``(D,)``, in variances of the data."""
        return cls(
            float(error.mean().sqrt()),
            tuple((error.sqrt() * model.target_std).tolist()),
            tuple(torch.where(variance > 0, error / variance, 0.0).tolist()),
            tuple(names or (f"coordinate {k}" for k in range(len(error)))),
        )

    def warn(self) -> None:
        """Warn of coordinates of which more than a third of the variance is left."""
        rows = zip(self.names, self.rms, self.unexplained, strict=True)
        bad = [f"{n} ({100 * u:.0f} %, error {e:.3g})" for n, e, u in rows if not u <= 1 / 3]
        if bad:
            warn(
                f"the model leaves more than a third of the variance of {', '.join(bad)} "
                "unexplained: give it more or wider data, name the angles of the manifold, or add "
                "the coordinates it depends on to features"
            )


@options("")
def fit_ensemble(
    model: Ensemble,
    transitions: TensorDictBase,
    *,
    epochs: Annotated[Count, "passes over the data"] = 40,
    batch_size: Annotated[Count, "transitions per step; a pass has at least eight steps"] = 256,
    lr: Annotated[Positive, "largest step size of Adam"] = 2e-3,
    beta: Annotated[
        Share, "exponent of the variance in the weight of a sample, see gaussian_nll"
    ] = 0.0,
    keys: tuple[NestedKey, NestedKey, NestedKey] = TRANSITION,
    names: Sequence[str] | None = None,
    seed: int = 0,
    progress: bool = False,
) -> FitReport:
    """Fit an ensemble to observed transitions by Gaussian NLL; return its held-out errors.

    Each member sees the batches in an order of its own. Adam with a one-cycle step size, best
    epoch kept.

    Args:
        model: ensemble to fit, in place; its normaliser is set from the data.
        transitions: any batch shape and precision, N in all; see :func:`~afm_rl.learning.collect`.
        keys: where state, action and next state are.
        names: of the coordinates of the tangent space.
        seed: seed of the order.
        progress: show progress.

    Raises:
        NonFiniteError: if an entry is not finite.

    Warns:
        UserWarning: if more than a third of the variance of a coordinate is left unexplained.

    >>> from tensordict import TensorDict
    >>> from afm_rl.spaces.manifold import Manifold
    >>> entries = {"observation": torch.randn(400, 1), "action": torch.randn(400, 1)}
    >>> cart = TensorDict(entries, [400])
    >>> cart["next", "observation"] = cart["observation"] + 0.1 * cart["action"]
    >>> model = Ensemble(Manifold(1), 1, features=[0], members=2, hidden=[8])
    >>> fit_ensemble(model, cart, lr=2e-2, batch_size=32).error < 0.2
    True
    """
    transitions = transitions.to(device_of(model))
    state, action, after = (transitions.get(key).flatten(0, -2) for key in as_keys(keys))
    for key, value in zip(keys, (state, action, after), strict=True):
        if not bool(value.isfinite().all()):
            raise NonFiniteError(f"transitions: {key!r} holds numbers that are not finite")
    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(state), generator=generator).to(state.device)
    state, action, after = state[order], action[order], after[order]
    change = model.manifold.difference(after, state)
    samples = check_count("transitions", len(state), low=2) - max(1, round(HELD_OUT * len(state)))
    return fit_changes(
        model,
        (state, action, change),
        samples,
        generator,
        epochs=epochs,
        batch_size=min(batch_size, max(16, samples // 8), samples),
        lr=lr,
        beta=beta,
        names=names,
        title="fitting the ensemble",
        progress=progress,
    )


def fit_changes(
    model: Ensemble,
    rows: tuple[Tensor, Tensor, Tensor],
    samples: int,
    generator: torch.Generator,
    *,
    epochs: int,
    batch_size: int,
    lr: float,
    beta: float = 0.0,
    one_cycle: bool = True,
    tolerance: float = 0.0,
    names: Sequence[str] | None,
    title: str,
    progress: bool,
) -> FitReport:
    """Fit to rows of states, actions and state changes; all but the first ``samples`` judge."""
    state, action, change = rows
    model.normalise_(model.inputs(state, action)[:samples], change[:samples])
    inputs = model.network_rows(state, action)
    target = model.standardise(change).to(inputs)
    optimizer = torch.optim.Adam(model.parameters(), lr=lr, fused=True)
    steps = samples // batch_size
    total, cycle = steps * epochs, None
    if one_cycle:
        cycle = torch.optim.lr_scheduler.OneCycleLR(optimizer, lr, total_steps=total)
    best, best_error = model.state_dict(), torch.full_like(target[0], torch.inf)
    last_loss = torch.inf
    with Bar(total=total, desc=title, shown=progress) as bar, torch.enable_grad():
        for _ in range(epochs):
            order = torch.rand(model.members, samples, generator=generator).argsort(-1)
            for batch in order[:, : steps * batch_size].to(inputs.device).split(batch_size, -1):
                mean, log_variance = model.member_moments(inputs[batch])
                loss = gaussian_nll(mean, log_variance, target[batch], beta).mean((-2, -1)).sum()
                optimizer.zero_grad(set_to_none=True)
                loss.backward()
                optimizer.step()
                if cycle is not None:
                    cycle.step()
                bar.update()
            error, held_out_loss = judge(model, inputs[samples:], target[samples:])
            bar.set_postfix_str(f"held-out error {float(error.mean().sqrt()):.4f}", refresh=False)
            if error.mean() < best_error.mean():
                best = {name: value.clone() for name, value in model.state_dict().items()}
                best_error = error
            if abs(held_out_loss - last_loss) < tolerance:
                break
            last_loss = held_out_loss
    model.load_state_dict(best)
    report = FitReport.of(model, best_error, target[samples:].var(0, correction=0), names)
    report.warn()
    return report


@torch.no_grad()
def judge(model: Ensemble, inputs: Tensor, target: Tensor) -> tuple[Tensor, float]:
    """Return what a model misses of held-out rows, and its loss on them.

    Returns:
        The mean squared error ``(D,)`` of the members' mean, in standardised units; the mean
        Gaussian NLL of the members.
    """
    mean, log_variance = model.member_moments(inputs.expand(model.members, *inputs.shape))
    error = (mean.mean(0) - target).square().mean(0)
    return error, float(gaussian_nll(mean, log_variance, target).mean())


@options("dynamics.pretrain")
def pretrain_ensemble(
    model: Ensemble,
    teacher: DynamicsModel,
    state_bounds: tuple[Tensor, Tensor],
    action_bounds: tuple[Tensor, Tensor],
    *,
    samples: Annotated[
        Count, Le(100_000_000), "transitions for training; a tenth more are held out"
    ] = 50_000,
    epochs: Annotated[Count, Le(100_000_000), "passes over the transitions"] = 16,
    batch_size: Annotated[Count, Le(100_000_000), "transitions per step and member"] = 256,
    lr: Annotated[Positive, Le(1), "largest step size of Adam"] = 2e-3,
    one_cycle: Annotated[
        bool, "the step size rises and falls; False: constant, as published"
    ] = True,
    tolerance: Annotated[
        NonNegative, "stop if the held-out loss changes by less; published: 1e-3"
    ] = 0.0,
    action_noise: Annotated[NonNegative, "0.1: actions perturbed by +-10 %"] = 0.0,
    seed: Annotated[Natural, "seed of data and order"] = 0,
    names: Sequence[str] | None = None,
    progress: bool = False,
) -> FitReport:
    """Fit an ensemble to a teacher by Gaussian NLL; return its held-out errors.

    States and actions are drawn uniformly from their bounds; each member sees the batches in
    an order of its own. Adam, best epoch kept.

    Args:
        model: ensemble to fit, in place; its normaliser is set from the data.
        teacher: model that gives the next states.
        state_bounds: lowest and highest state, ``(S,)`` each.
        action_bounds: lowest and highest action, ``(A,)`` each.
        names: of the coordinates of the tangent space, for the warning.
        progress: show progress.

    Warns:
        UserWarning: if more than a third of the variance of a coordinate is left unexplained.
    """
    check_count("dynamics.pretrain.samples", samples, low=batch_size)
    generator, device = torch.Generator().manual_seed(seed), device_of(model)
    total = samples + samples // 10
    low, high, lowest, highest = (end.to(device) for end in (*state_bounds, *action_bounds))
    state = teacher.manifold.project(uniform(low, high, total, generator))
    action = uniform(lowest, highest, total, generator)
    factor = 1 + action_noise * (2 * torch.rand(action.shape, generator=generator) - 1)
    factor = factor.to(device)
    with torch.no_grad():
        change = teacher.manifold.difference(teacher(state, action * factor), state)
    return fit_changes(
        model,
        (state, action, change),
        samples,
        generator,
        epochs=epochs,
        batch_size=batch_size,
        lr=lr,
        one_cycle=one_cycle,
        tolerance=tolerance,
        names=names,
        title="pre-training the ensemble",
        progress=progress,
    )
