"""Training of flows: the loss, a loop, and the refinement on one robot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor, nn

from afm_rl.compiling.devices import device_of
from afm_rl.correction.achievable import MODES
from afm_rl.correction.action_flow import ActionFlow
from afm_rl.correction.experts import Rows, fit_experts
from afm_rl.correction.network import AxisNetwork
from afm_rl.correction.paper_flow import PaperFlow
from afm_rl.correction.training.counterfactuals import Windows
from afm_rl.correction.training.prior import Drawn
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import (
    ConfigurationError,
    check_choice,
    check_count,
    check_instance,
    check_number,
)
from afm_rl.learning import InPlaceLoss
from afm_rl.progress import Bar
from afm_rl.regimes import Regime

SOURCE_STD = 0.3  # of the path's start around the plan, in half ranges
EFFECT_WEIGHT, SIZE_WEIGHT = 0.6, 0.5  # of the loss of effects, and of the size of all errors
PRECISION = 0.01  # half ranges: smaller errors count less
States = tuple[Tensor, Tensor] | Tensor


def flow_losses(
    network: AxisNetwork, drawn: Drawn, mode: str, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    r"""Return the losses ``(N,)`` of velocity and effect.

    .. math:: \|r\|^2 + 0.5\,|r|_\epsilon,\ r = v(c, u_0, \tau, x_\tau) - (x_1 - x_0),\qquad
              |r|_\epsilon,\ r = \hat T(u) - T(u),\qquad
              |r|_\epsilon = \sqrt{r^2 + \epsilon^2} - \epsilon

    with :math:`x_\tau = (1 - \tau) x_0 + \tau x_1` (conditional flow matching, Lipman et al.
    2023; paper, eq. 6), :math:`x_0 = u_0 + \sigma\,\epsilon` around the plan and the intended
    action :math:`x_1 = T^{-1}(u_0)`, both as means over plans and axes.
    """
    with torch.no_grad():
        experts = fit_experts(drawn.rows)
    encoded = network.encode(drawn.rows, experts)
    noise = torch.randn(drawn.planned.shape, generator=generator).to(drawn.planned)
    tau = torch.rand(*drawn.planned.shape[:-1], 1, generator=generator).to(noise)
    start = drawn.planned + SOURCE_STD * noise
    point = torch.lerp(start, drawn.intended, tau)
    velocity = network.velocity(network.ask(encoded, drawn.planned, mode), tau, point)
    off = velocity - (drawn.intended - start)
    loss = (off.square() + SIZE_WEIGHT * _size(off)).mean((-2, -1))
    return loss, _size(network.effect(encoded, drawn.probe) - drawn.effect).mean((-2, -1))


def _size(error: Tensor) -> Tensor:
    """Return the size of errors, smooth at zero: it asks for precision where it can be had."""
    return (error.square() + PRECISION**2).sqrt() - PRECISION


class CFMLoss(InPlaceLoss):
    """The loss of :func:`flow_losses` as a TorchRL loss module.

    Args:
        network: the network to train.
        saturation: mode of the intended actions.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.
        seed: of the times and starting points.

    Keys (change them with ``set_keys``): ``executed``, ``effective``, ``std`` ``(*B, K, A)`` and
    ``valid`` ``(*B, K, 1)`` describe the regime; ``planned``, ``intended``, ``probe`` and
    ``effect`` ``(*B, C, A)`` are asked and known. All in half ranges.
    """

    @dataclass
    class _AcceptedKeys:
        """Default keys."""

        executed: NestedKey = "executed"
        effective: NestedKey = "effective"
        std: NestedKey = "std"
        valid: NestedKey = "valid"
        planned: NestedKey = "planned"
        intended: NestedKey = "intended"
        probe: NestedKey = "probe"
        effect: NestedKey = "effect"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    network: AxisNetwork
    network_params: None
    target_network_params: None
    out_keys = ["loss_cfm"]

    def __init__(
        self,
        network: AxisNetwork,
        saturation: str = "mixed",
        reduction: str = "mean",
        seed: int = 0,
    ) -> None:
        super().__init__(reduction)
        self.network = check_instance("loss.network", network, AxisNetwork)
        self.saturation = check_choice("loss.saturation", saturation, MODES)
        self._generator = torch.Generator().manual_seed(check_count("loss.seed", seed, low=0))

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``loss_cfm`` for examples ``(*B)``."""
        parts = [tensordict.get(key) for key in self.in_keys]
        batch = parts[0].shape[:-2]
        parts = [part.reshape(-1, *part.shape[-2:]) for part in parts]
        drawn = Drawn(Rows(*parts[:4]), *parts[4:])
        velocity, effect = flow_losses(self.network, drawn, self.saturation, self._generator)
        return self._reduced((velocity + EFFECT_WEIGHT * effect).view(batch), tensordict)


def train_flow(
    flow: ActionFlow | PaperFlow,
    model: DynamicsModel,
    regime: Regime,
    states: States,
    *,
    iterations: int = 1000,
    batch_size: int = 160,
    lr: float = 1e-3,
    seed: int = 0,
    progress: bool = False,
) -> float:
    """Train a flow on counterfactuals: what a robot's model would show under imagined regimes.

    The universal :class:`~afm_rl.correction.ActionFlow` is refined from where it is, by Adam with a
    one-cycle step size and clipped gradients; the published flow from nothing, by Adam alone.

    Args:
        flow: trained in place.
        model: base dynamics model, not changed.
        regime: prior over regimes.
        states: lowest and highest state, ``(S,)`` each; or a pool of observed ones, ``(P, S)``,
            where states keep to a small part of their box.
        iterations: gradient steps.
        batch_size: examples per step.
        lr: largest step size.
        seed: of everything drawn.
        progress: show a progress bar.

    Returns:
        Root mean square error of the corrected action on new examples, as the flow measures it.

    Raises:
        ConfigurationError: for a setting that cannot be used.
    """
    check_count("corrector.train.iterations", iterations)
    check_count("corrector.train.batch_size", batch_size, low=2)
    check_count("corrector.train.seed", seed, low=0)
    check_number("corrector.train.lr", lr, low=0.0, open_low=True)
    check_states(states, model)
    generator = torch.Generator().manual_seed(seed)
    device = device_of(model)
    if isinstance(states, tuple):
        states = states[0].to(device), states[1].to(device)
    else:
        states = states.to(device)

    world = model, regime, states
    if isinstance(flow, PaperFlow):
        paper = flow
        optimise(
            list(paper.parameters()),
            lambda: paper.training_loss(*world, batch_size, generator),
            iterations,
            lr,
            progress,
            plain=True,
        )
        return paper.held_out_error(*world, 2048, generator)
    windows, network, mode = Windows(flow), flow.network, flow.tick.saturation

    def loss() -> Tensor:
        drawn = windows.draw(*world, batch_size, generator)
        velocity, effect = flow_losses(network, drawn, mode, generator)
        return (velocity + EFFECT_WEIGHT * effect).mean()

    optimise(list(flow.parameters()), loss, iterations, lr, progress)
    return windows.error(windows.draw(*world, 2048, generator))


def check_states(states: States, model: DynamicsModel) -> None:
    """Check that states can be drawn from a box, or from a pool.

    Raises:
        ConfigurationError: for sizes that do not fit the model, or ends that are not finite.
    """
    for rows in states if isinstance(states, tuple) else [states]:
        if rows.shape[-1] != model.state_size or not bool(rows.isfinite().all()):
            raise ConfigurationError(
                f"states={rows.tolist() if rows.numel() < 20 else tuple(rows.shape)}: expected "
                f"finite states of {model.state_size} numbers; give the box in which it moves"
            )


def optimise(
    parameters: list[nn.Parameter],
    loss: Callable[[], Tensor],
    iterations: int,
    lr: float,
    progress: bool = False,
    plain: bool = False,
) -> None:
    """Minimise a loss that is drawn anew at every step.

    Adam with a one-cycle step size, gradients clipped to norm 1; ``plain``: Adam alone.
    """
    for parameter in parameters:
        parameter.requires_grad_(True)
    optimizer = torch.optim.Adam(parameters, lr=lr, fused=True)
    cycle = None
    if not plain:
        cycle = torch.optim.lr_scheduler.OneCycleLR(optimizer, lr, total_steps=iterations)
    bar = Bar(range(iterations), desc="training the flow", shown=progress)
    for step in bar:
        with torch.enable_grad():
            value = loss()
            optimizer.zero_grad(set_to_none=True)
            value.backward()
        if cycle is not None:
            torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        if cycle is not None:
            cycle.step()
        if progress and step % 100 == 0:
            bar.set_postfix_str(f"loss {value.item():.4f}", refresh=False)
