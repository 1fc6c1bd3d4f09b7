"""Training of the published flow on one robot's model."""

from __future__ import annotations

from typing import Annotated

import torch
from annotated_types import Ge, Le
from torch import Tensor

from afm_rl.compiling.devices import device_of
from afm_rl.correction.paper_flow import PaperFlow
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_instance
from afm_rl.options import Count, Natural, Positive, options
from afm_rl.progress import Bar

LOOKS, APART, EXAMPLES = 100, 100, 2048  # a look costs as much as some tens of steps


@options("corrector.train")
def train_flow(
    flow: PaperFlow,
    model: DynamicsModel,
    states: tuple[Tensor, Tensor] | Tensor,
    *,
    iterations: Annotated[Count, Le(100_000_000), "gradient steps"] = 1000,
    batch_size: Annotated[int, Ge(2), Le(100_000_000), "examples per step"] = 160,
    lr: Annotated[Positive, Le(1), "step size of Adam"] = 1e-3,
    seed: Annotated[Natural, "seed of all random numbers"] = 0,
    progress: bool = False,
) -> float:
    """Train the published flow by Adam, on transitions of one action registered as another's.

    At a constant step size its error can grow again, so the weights that did best on held-out
    examples are kept, of at most a hundred looks.

    :class:`~afm_rl.correction.ActionFlow` needs no training.

    Args:
        flow: trained in place.
        model: base dynamics model, not changed.
        states: lowest and highest state, ``(S,)`` each; or a pool of observed ones, ``(P, S)``,
            where states keep to a small part of their box.
        progress: show a progress bar.

    Returns:
        Root mean square error of the corrected action on new examples, in action units.

    Raises:
        ConfigurationError: if ``flow`` is no :class:`PaperFlow`, or states are not finite or of
            another size.
    """
    check_instance("flow", flow, PaperFlow)
    for rows in states if isinstance(states, tuple) else [states]:
        if rows.shape[-1] != model.state_size or not bool(rows.isfinite().all()):
            raise ConfigurationError(
                f"states={rows.tolist() if rows.numel() < 20 else tuple(rows.shape)}: expected "
                f"finite states of {model.state_size} numbers; give the box in which it moves"
            )
    generator, device = torch.Generator().manual_seed(seed), device_of(model)
    if isinstance(states, tuple):
        states = states[0].to(device), states[1].to(device)
    else:
        states = states.to(device)
    parameters = [parameter.requires_grad_(True) for parameter in flow.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=lr, fused=True)
    bar = Bar(range(iterations), desc="training the flow", shown=progress)
    best, best_error = flow.state_dict(), torch.inf
    for step in bar:
        with torch.enable_grad():
            loss = flow.training_loss(model, states, batch_size, generator)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
        optimizer.step()
        if (step + 1) % max(APART, iterations // LOOKS) and step + 1 < iterations:
            continue
        held_out = torch.Generator().manual_seed(seed + 1)  # the same examples at each look
        error = flow.held_out_error(model, states, EXAMPLES, held_out)
        if error < best_error:
            best = {name: value.clone() for name, value in flow.state_dict().items()}
            best_error = error
        bar.set_postfix_str(f"held-out error {error:.4f}", refresh=False)
    flow.load_state_dict(best)
    return flow.held_out_error(model, states, EXAMPLES, generator)
