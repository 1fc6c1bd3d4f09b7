"""Optimisers for learning step by step."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from afm_rl.errors import ConfigurationError, check_count, check_number, refusing
from afm_rl.options import Positive, options


class ObGD(Optimizer):
    r"""Overshooting-bounded gradient descent with eligibility traces (Elsayed et al. 2024).

    .. math:: z \leftarrow \gamma\lambda z + g,\qquad
              w \leftarrow w - \frac{\eta}{\max(1, M)}\, \delta z,\qquad
              M = \eta \kappa \max(|\delta|, 1) \|z\|_1

    ("Streaming Deep Reinforcement Learning Finally Works", arXiv 2410.14606.) Here :math:`g` is the
    gradient in ``.grad`` and :math:`\delta` the error given to :meth:`step`. To descend a loss,
    leave :math:`\delta = 1`. Without a ``trace``, as is usual for losses, z is the gradient.

    The prediction on the sample then changes by at most
    :math:`\max|g| / (\kappa \max(|\delta|, 1))` of the error, if it is linear in the
    parameters: with inputs of order 1 the error does not change its sign. Beyond 1,
    :math:`\kappa` leaves room for the function not being linear.

    Stacked parameters hold independent learners: with ``lead_dims=k`` the first k dimensions
    of every parameter, L, count learners, each bounded by the norm of its own gradients. Groups
    of parameters have separate bounds.

    Args:
        params: parameters, or groups of them with their own settings.
        lr: step size :math:`\eta`, > 0.
        kappa: :math:`\kappa`, > 0.
        trace: decay of traces :math:`\gamma\lambda`, [0, 1]; 0: none, and nothing is stored.
        lead_dims: leading dimensions that count learners; 0: one learner owns all.

    Raises:
        ConfigurationError: for settings out of range, or parameters whose leading dimensions
            differ.

    >>> w = torch.nn.Parameter(torch.tensor([3.0, 1.0]))
    >>> w.grad = torch.tensor([4.0, 0.0])
    >>> ObGD([w]).step()
    >>> w.data
    tensor([2.5000, 1.0000])
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 1.0,
        kappa: float = 2.0,
        lead_dims: int = 0,
        trace: float = 0.0,
    ) -> None:
        defaults = {"lr": lr, "kappa": kappa, "lead_dims": lead_dims, "trace": trace}
        super().__init__(params, defaults)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Add parameters with their own settings."""
        super().add_param_group(param_group)
        group = self.param_groups[-1]
        for name in ("lr", "kappa"):
            check_number(f"updater.{name}", group[name], low=0.0, open_low=True)
        check_number("updater.trace", group["trace"], low=0.0, high=1.0)
        check_count("updater.lead_dims", group["lead_dims"], low=0)
        _lead(group["params"], group["lead_dims"])

    @torch.no_grad()
    def step(self, delta: Tensor | float = 1.0) -> None:  # type: ignore[override]
        r"""Take one step.

        Args:
            delta: error :math:`\delta`: one number of any shape, or one per learner, which
                broadcasts to L. Learners with an error of 0 do not change.

        Raises:
            ConfigurationError: for an error that is no finite number, or does not fit L.
        """
        if not isinstance(delta, Tensor):
            check_number("delta", delta)
        for group in self.param_groups:
            parameters = [p for p in group["params"] if p.grad is not None]
            if not parameters:
                continue
            dims, lr = group["lead_dims"], group["lr"]
            lead = _lead(parameters, dims)
            traces = [self._trace(p, group["trace"]) for p in parameters]
            norms = [torch.linalg.vector_norm(z.reshape(*lead, -1), 1, -1) for z in traces]
            size = torch.stack(norms).sum(0)
            error = torch.as_tensor(delta, dtype=size.dtype, device=size.device)
            expected = f"expected one number, or {tuple(size.shape)}"
            with refusing(f"delta of shape {tuple(error.shape)}: {expected}"):
                error = (error.reshape(()) if error.numel() == 1 else error).expand_as(size)
            bound = lr * group["kappa"] * error.abs().clamp_min(1) * size
            scale = error * (lr / bound.clamp_min(1))
            for parameter, trace in zip(parameters, traces, strict=True):
                share = scale.to(parameter)[(..., *[None] * (parameter.dim() - dims))]
                parameter.addcmul_(trace, share, value=-1)

    def _trace(self, parameter: Tensor, decay: float) -> Tensor:
        """Return the trace of a parameter, which the gradient joins."""
        gradient: Tensor = parameter.grad  # type: ignore[assignment]
        if not decay:
            return gradient
        trace = self.state[parameter].setdefault("trace", torch.zeros_like(parameter))
        return trace.mul_(decay).add_(gradient)


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


TINY = 1e-8  # keeps a quotient finite


class ResetAdam(Optimizer):
    r"""Adam that is initialised again at every step, as in the published runs.

    The first step of Adam is :math:`w \leftarrow w - \eta\, g / (|g| + \epsilon)`, a sign
    step. It is elementwise and zero gradients do not move, so stacked missions stay
    independent and are masked by masking their loss.

    Args:
        params: parameters.

    >>> w = nn.Parameter(torch.tensor([1.0, 1.0]))
    >>> w.grad = torch.tensor([5.0, 0.0])
    >>> ResetAdam([w], lr=0.1).step()
    >>> w.data
    tensor([0.9000, 1.0000])
    """

    piece = 2**16
    """Numbers that are stepped at once: three times 256 KiB in float32 fit into a cache."""

    @options("updater")
    def __init__(
        self,
        params: Iterable[nn.Parameter],
        lr: Annotated[Positive, "step size"] = 1e-3,
    ) -> None:
        super().__init__(params, {"lr": lr})

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """Take one step, in pieces: one pass over memory instead of three."""
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                both = [(parameter,), (parameter.grad,)]
                if parameter.is_contiguous() and parameter.grad.is_contiguous():
                    both = [part.view(-1).split(self.piece) for (part,) in both]
                for values, slopes in zip(*both, strict=True):
                    values.addcdiv_(slopes, slopes.abs().add_(TINY), value=-group["lr"])
