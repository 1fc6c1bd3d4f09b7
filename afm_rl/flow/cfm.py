"""Conditional flow matching: the loss and the training of a flow."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tqdm.auto import tqdm

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import check_count, check_instance, check_number
from afm_rl.flow.base import Examples, Flow
from afm_rl.flow.saturation import LIMIT
from afm_rl.learning import InPlaceLoss
from afm_rl.regimes import Regime

POOL = 16  # batches kept of the examples that are used more than once
PLANS = 4  # plans per context among them
WEIGHT, PRECISE = 0.2, 0.02  # of the loss of effects; half ranges: smaller misses count less
BLOCK = 8  # batches made at once where each example is used once: many small calls are slow


class CFMLoss(InPlaceLoss):
    r"""Conditional flow matching with straight paths.

    .. math:: \mathcal{L} = \| v_\phi(c, u_0, \tau, x_\tau) - (x_1 - x_0) \|^2,\qquad
              x_\tau = (1-\tau) x_0 + \tau x_1,\quad \tau \sim U[0, 1]

    (Lipman et al. 2023; paper, eq. 6: its factor 1/(1-tau) cancels, since
    :math:`(x_1 - x_\tau)/(1-\tau) = x_1 - x_0`.) A flow that also knows what actions are worth
    (:meth:`~afm_rl.flow.base.Flow.effect`) learns that with

    .. math:: \mathcal{L}_e = \kappa\,(\sqrt{r^2 + \epsilon^2} - \epsilon),\qquad
              r = \hat T(u) - u_\mathrm{eff},

    the mean over axes, which forgives what cannot be known and asks for precision where it can
    be had.

    Args:
        flow: the flow to train.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.
        seed: seed of the times and source points drawn.

    Keys (change them with ``set_keys``): ``features`` ("features"), ``planned``
    ("planned"), ``intended`` ("intended"), ``probe`` ("probe") and ``worth`` ("worth"), the last
    two for flows with an effect only.
    """

    @dataclass
    class _AcceptedKeys:
        """Default keys."""

        features: NestedKey = "features"
        planned: NestedKey = "planned"
        intended: NestedKey = "intended"
        probe: NestedKey = "probe"
        worth: NestedKey = "worth"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    flow: Flow
    flow_params: None
    target_flow_params: None
    out_keys = ["loss_cfm"]

    def __init__(self, flow: Flow, reduction: str = "mean", seed: int = 0) -> None:
        super().__init__(reduction)
        self.flow = check_instance("loss.flow", flow, Flow)
        self._generator = torch.Generator().manual_seed(check_count("loss.seed", seed, low=0))

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries read."""
        keys = super().in_keys
        return keys if self.flow.has_effect else keys[:3]

    @in_keys.setter
    def in_keys(self, keys: list[NestedKey]) -> None:
        self._in_keys = keys

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``loss_cfm`` for examples ``(*B)``."""
        features, *actions = (tensordict.get(key) for key in self.in_keys)
        unit, end, *other = (self.flow.normalise(action) for action in actions)
        noise = torch.randn(unit.shape, generator=self._generator).to(unit)
        tau = torch.rand((*unit.shape[:-1], 1), generator=self._generator).to(unit)
        start = self.flow.source(unit, noise)
        known = self.flow.read(features)
        velocity = self.flow(known, unit, tau, torch.lerp(start, end, tau))
        loss = (velocity - (end - start)).square().mean(-1)
        if other:
            probe, worth = other
            miss = self.flow.effect(known, probe) - worth.clamp(-LIMIT, LIMIT)
            size = (miss.square() + PRECISE**2).sqrt() - PRECISE
            loss = loss + WEIGHT * size.mean(-1)
        return self._reduced(loss, tensordict)


def train_flow(
    flow: Flow,
    model: DynamicsModel,
    regime: Regime,
    states: tuple[torch.Tensor, torch.Tensor] | torch.Tensor,
    *,
    iterations: int = 10_000,
    batch_size: int = 512,
    lr: float = 2e-3,
    reuse: int | None = None,
    seed: int = 0,
    progress: bool = False,
) -> float:
    """Train a flow on counterfactual examples made on the fly; return its held-out error.

    Adam with a one-cycle step size, gradients clipped to norm 1.

    Args:
        flow: trained in place.
        model: base dynamics model, not changed.
        regime: prior over regimes.
        states: lowest and highest state, ``(S,)`` each; or a pool of observed ones, ``(P, S)``,
            where states keep to a small part of their box.
        iterations: gradient steps.
        batch_size: examples per step.
        lr: largest step size.
        reuse: how often an example is used, on average: 1 makes every batch anew, more
            saves time where the model is slow. None: 1 for a model without parameters, 32
            for a learned one.
        seed: seed of everything drawn.
        progress: show a progress bar.

    Returns:
        Root mean square error of the corrected action, in half ranges, on new examples.
    """
    check_count("corrector.train.iterations", iterations)
    check_count("corrector.train.batch_size", batch_size, low=2)
    if reuse is None:
        reuse = 32 if any(True for _ in model.parameters()) else 1
    check_count("corrector.train.reuse", reuse)
    check_count("corrector.train.seed", seed, low=0)
    check_number("corrector.train.lr", lr, low=0.0, open_low=True)
    plans = 1 if reuse == 1 else PLANS
    generator = torch.Generator().manual_seed(seed)
    loss_module = CFMLoss(flow, seed=seed + 1)
    optimizer = torch.optim.Adam(flow.parameters(), lr=lr, fused=True)
    cycle = torch.optim.lr_scheduler.OneCycleLR(optimizer, lr, total_steps=iterations)

    def draw(count: int) -> Examples:
        with torch.no_grad():
            return flow.examples(model, regime, states, count, generator, plans)

    if reuse == 1:
        batches = _fresh(draw, batch_size)
    else:
        batches = _reused(draw, batch_size, reuse, generator)
    bar = tqdm(range(iterations), desc="training the flow", disable=None if progress else True)
    for step in bar:
        batch = next(batches)
        with torch.enable_grad():
            loss = loss_module(TensorDict(batch._asdict(), [batch_size]))["loss_cfm"]
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
        torch.nn.utils.clip_grad_norm_(flow.parameters(), 1.0)
        optimizer.step()
        cycle.step()
        if progress and step % 200 == 0:
            bar.set_postfix(loss=f"{loss.item():.4f}")
    return held_out_error(flow, draw(2048))


def _fresh(draw: Callable[[int], Examples], size: int) -> Iterator[Examples]:
    """Yield batches of new examples, made several batches at once."""
    while True:
        yield from map(
            Examples._make, zip(*(part.split(size) for part in draw(BLOCK * size)), strict=True)
        )


def _reused(
    draw: Callable[[int], Examples], size: int, reuse: int, generator: torch.Generator
) -> Iterator[Examples]:
    """Yield batches from a pool in which a new batch now and then takes the oldest one's place."""
    pool = draw(POOL * size)
    for oldest in itertools.cycle(range(POOL)):
        for _ in range(reuse):
            chosen = torch.randint(POOL * size, (size,), generator=generator)
            yield Examples(*(part[chosen] for part in pool))
        for kept, new in zip(pool, draw(size), strict=True):
            kept[oldest * size : (oldest + 1) * size] = new


@torch.no_grad()
def held_out_error(flow: Flow, examples: Examples) -> float:
    """Return the RMSE of the corrected action in half ranges."""
    context = flow.told(examples.features)
    corrected = flow.correct(context, examples.features[..., :0], examples.planned).action
    miss = flow.normalise(corrected) - flow.normalise(examples.intended)
    return float(miss.square().mean().sqrt())
