"""What no dynamics model may predict."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.dynamics.base import DynamicsModel
from afm_rl.errors import ConfigurationError, warn
from afm_rl.faults import finite


@torch.no_grad()
def check_predictions(name: str, model: DynamicsModel, state: Tensor, action: Tensor) -> None:
    """Refuse a model that changes what it is given, or that predicts no numbers.

    A model that predicts no motion leads to a warning. States that are not finite are ignored.

    Args:
        name: of the model, for messages.
        model: f.
        state: ``(*B, S)``.
        action: ``(*B, A)``.

    Raises:
        ConfigurationError: for such a model.

    >>> from afm_rl.dynamics import KnownDynamics
    >>> from afm_rl.spaces.manifold import Manifold
    >>> model = KnownDynamics(lambda state, action: state.add_(action), Manifold(1), 1)
    >>> check_predictions("wrapper.model", model, torch.zeros(1), torch.ones(1))
    Traceback (most recent call last):
    afm_rl.errors.ConfigurationError: wrapper.model changes its argument state in place; \
expected a new tensor: begin the function with state = state.clone()
    """
    known = finite(state)
    if not bool(known.any()):
        return
    given = {"state": state.clone(), "action": action.clone()}
    ahead = model(*given.values())[known]
    for kind, before in (("state", state), ("action", action)):
        if bool((given[kind] != before)[known].any()):
            raise ConfigurationError(
                f"{name} changes its argument {kind} in place; expected a new tensor: begin the "
                f"function with {kind} = {kind}.clone()"
            )
    if not bool(finite(ahead).any()):
        first = ", ".join(
            f"{kind} {[round(x, 3) for x in part[known][0].tolist()]}"
            for kind, part in (("state", state), ("action", action))
        )
        raise ConfigurationError(
            f"{name} predicts no finite numbers, for example for {first}; expected the next state: "
            "check its divisions, roots and units"
        )
    if bool((ahead == state[known]).all()):
        warn(
            f"{name} predicts no motion: the next state equals the current one for all actions; "
            "expected the state after one step, because nothing can be corrected without it"
        )
