"""Optimisers for learning step by step."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from afm_rl.errors import ConfigurationError, check_count, check_number


def bounded_step_size(size: Tensor, delta: Tensor, lr: float, kappa: float) -> Tensor:
    r"""Return :math:`\eta / \max(1, M)`, :math:`M = \eta \kappa \max(|\delta|, 1) \|z\|_1`.

    ``size`` is :math:`\|z\|_1`, the sum of the traces' absolute values, ``(*L,)``; beyond 1
    :math:`\kappa` leaves room for the function not being linear.

    >>> bounded_step_size(torch.tensor([0.1, 4.0]), torch.tensor(0.5), lr=1.0, kappa=2.0)
    tensor([1.0000, 0.1250])
    """
    return lr / (lr * kappa * delta.abs().clamp_min(1) * size).clamp_min(1)


class ObGD(Optimizer):
    r"""Overshooting-bounded gradient descent with eligibility traces (Elsayed et al. 2024).

    .. math:: z \leftarrow \gamma\lambda z + g,\qquad
              w \leftarrow w - \frac{\eta}{\max(1, M)}\, \delta z,\qquad
              M = \eta \kappa \max(|\delta|, 1) \|z\|_1

    ("Streaming Deep Reinforcement Learning Finally Works", arXiv 2410.14606.) Here :math:`g`
    is the gradient in ``.grad`` and :math:`\delta` the error given to :meth:`step`. To
    descend a loss, leave :math:`\delta = 1`. For TD(:math:`\lambda`), make :math:`g` the
    gradient of minus the value and give the TD error.

    The prediction on the sample then changes by at most
    :math:`\max|g| / (\kappa \max(|\delta|, 1))` of the error, if it is linear in the
    parameters: with inputs of order 1 the error does not change its sign.

    Stacked parameters hold independent learners: with ``lead_dims=k`` the first k dimensions
    of every parameter, L, count learners, each bounded by the norm of its own traces. Groups
    of parameters are bounded apart. Where an episode ends, call :meth:`reset`.

    Args:
        params: parameters, or groups of them with settings of their own.
        lr: step size :math:`\eta`, > 0.
        kappa: :math:`\kappa`, > 0.
        gamma: discount, [0, 1].
        lmbda: decay of the traces, [0, 1]; 0 for supervised learning, which stores no traces.
        lead_dims: leading dimensions that count learners; 0: one learner owns all.

    Raises:
        ConfigurationError: for settings out of range, or parameters whose leading dimensions
            differ.

    >>> w = torch.nn.Parameter(torch.zeros(2))  # values of two states
    >>> optimizer = ObGD([w], lmbda=0.9)
    >>> (-w[0]).backward()  # state 0 was visited
    >>> optimizer.step(delta=3.0)  # and was worth 3 more than predicted
    >>> w.data
    tensor([0.5000, 0.0000])
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 1.0,
        kappa: float = 2.0,
        gamma: float = 1.0,
        lmbda: float = 0.0,
        lead_dims: int = 0,
    ) -> None:
        settings = {"lr": lr, "kappa": kappa, "gamma": gamma, "lmbda": lmbda}
        super().__init__(params, {**settings, "lead_dims": lead_dims})

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Add parameters with settings of their own."""
        super().add_param_group(param_group)
        group = self.param_groups[-1]
        for name in ("lr", "kappa"):
            check_number(f"updater.{name}", group[name], low=0.0, open_low=True)
        for name in ("gamma", "lmbda"):
            check_number(f"updater.{name}", group[name], low=0.0, high=1.0)
        check_count("updater.lead_dims", group["lead_dims"], low=0)
        _lead(group["params"], group["lead_dims"])

    @torch.no_grad()
    def step(  # type: ignore[override]
        self, delta: Tensor | float = 1.0, closure: Callable[[], float] | None = None
    ) -> float | None:
        r"""Take one step.

        Args:
            delta: error :math:`\delta`: one number of any shape, or one per learner, which
                broadcasts to L.
                Learners with an error of 0 stay where they are.
            closure: computes the gradients first; returns the loss.

        Raises:
            ConfigurationError: for an error that is no finite number, or does not fit L.
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        if not isinstance(delta, Tensor):
            check_number("delta", delta)
        for group in self.param_groups:
            decay = group["gamma"] * group["lmbda"]
            pairs = [(p, z) for p in group["params"] if (z := self._trace(p, decay)) is not None]
            if not pairs:
                continue
            dims = group["lead_dims"]
            lead = _lead([z for _, z in pairs], dims)
            norms = [torch.linalg.vector_norm(z.reshape(*lead, -1), 1, -1) for _, z in pairs]
            size = torch.stack(norms).sum(0)
            error = _errors(delta, size)
            scale = error * bounded_step_size(size, error, group["lr"], group["kappa"])
            for parameter, trace in pairs:
                share = scale.to(trace)[(..., *[None] * (trace.dim() - dims))]
                parameter.addcmul_(trace, share, value=-1)
        return loss

    @torch.no_grad()
    def reset(self, where: Tensor | None = None) -> None:
        """Forget the traces, as at the end of an episode.

        Args:
            where: the learners that forget, boolean ``(*L,)``; None for all.
        """
        for state in self.state.values():
            if where is None:
                state.clear()
            elif "trace" in state:
                state["trace"][where] = 0.0

    def _trace(self, parameter: Tensor, decay: float) -> Tensor | None:
        """Return the parameter's trace, brought up to date; None if it never had a gradient."""
        gradient = parameter.grad
        if decay == 0.0:
            return gradient
        state = self.state[parameter]
        if "trace" not in state:
            if gradient is None:
                return None
            state["trace"] = torch.zeros_like(parameter)
        trace = state["trace"]
        if trace.shape != parameter.shape:
            raise ConfigurationError(
                f"traces of shape {tuple(trace.shape)} for parameters of shape "
                f"{tuple(parameter.shape)}: call reset() when learners come or go"
            )
        trace.mul_(decay)
        return trace if gradient is None else trace.add_(gradient)


def _lead(tensors: list[Tensor], dims: int) -> torch.Size:
    """Return the leading dimensions that all tensors share."""
    lead = tensors[0].shape[:dims]
    for tensor in tensors:
        if tensor.dim() < dims or tensor.shape[:dims] != lead:
            raise ConfigurationError(
                f"updater.lead_dims={dims}: parameters of shape {tuple(tensors[0].shape)} and "
                f"{tuple(tensor.shape)} do not share {dims} leading dimensions"
            )
    return lead


def _errors(delta: Tensor | float, size: Tensor) -> Tensor:
    """Return one error per learner."""
    error = torch.as_tensor(delta, dtype=size.dtype, device=size.device)
    try:
        return (error.reshape(()) if error.numel() == 1 else error).expand_as(size)
    except RuntimeError:
        raise ConfigurationError(
            f"delta of shape {tuple(error.shape)}: expected one number, or {tuple(size.shape)}"
        ) from None


PIECE = 2**16  # numbers: three times 256 KiB in float32 fit into a second-level cache


class ResetAdam(Optimizer):
    r"""Adam that is created anew at every step, as in the published runs.

    The first step of Adam is :math:`w \leftarrow w - \eta\, g / (|g| + \epsilon)`, a sign
    step. It is elementwise and zero gradients do not move, so stacked missions stay
    independent and are masked by masking their loss.

    Args:
        params: parameters.
        lr: step size, > 0.
        eps: keeps the quotient finite, > 0.

    >>> w = nn.Parameter(torch.tensor([1.0, 1.0]))
    >>> w.grad = torch.tensor([5.0, 0.0])
    >>> ResetAdam([w], lr=0.1).step()
    >>> w.data
    tensor([0.9000, 1.0000])
    """

    def __init__(self, params: Iterable[nn.Parameter], lr: float = 1e-3, eps: float = 1e-8) -> None:
        check_number("updater.lr", lr, low=0.0, open_low=True)
        check_number("updater.eps", eps, low=0.0, open_low=True)
        super().__init__(params, {"lr": lr, "eps": eps})

    @torch.no_grad()
    def step(  # type: ignore[override]
        self, closure: Callable[[], float] | None = None
    ) -> float | None:
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    _sign_step(parameter, parameter.grad, group["lr"], group["eps"])
        return loss


def _sign_step(parameter: Tensor, gradient: Tensor, lr: float, eps: float) -> None:
    """Step in pieces that stay in cache: one pass over memory instead of three."""
    pair: list[tuple[Tensor, ...]] = [(parameter,), (gradient,)]
    if parameter.is_contiguous() and gradient.is_contiguous():
        pair = [whole.view(-1).split(PIECE) for whole in (parameter, gradient)]
    for values, slopes in zip(*pair, strict=True):
        values.addcdiv_(slopes, slopes.abs().add_(eps), value=-lr)
