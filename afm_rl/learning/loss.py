"""What the losses of this library share."""

from __future__ import annotations

from dataclasses import fields

from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from afm_rl.errors import check_choice

REDUCTIONS = ("mean", "sum", "none")


class InPlaceLoss(LossModule):
    """A TorchRL loss on a module as it is, without a functional copy of its parameters.

    So planner, transform and optimiser go on sharing one module. The entries read are those
    of ``_AcceptedKeys``, in order; change them with ``set_keys`` or through ``in_keys``.
    ``loss_mask_key`` is honoured.

    Args:
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` (one value per batch element).
    """

    def __init__(self, reduction: str) -> None:
        self._in_keys: list[NestedKey] | None = None
        super().__init__()
        self.reduction = check_choice("loss.reduction", reduction, REDUCTIONS)

    @property
    def functional(self) -> bool:
        """The loss works on the module itself."""
        return False

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries read."""
        keys = self.tensor_keys
        return self._in_keys or [getattr(keys, field.name) for field in fields(keys)]

    @in_keys.setter
    def in_keys(self, keys: list[NestedKey]) -> None:
        self._in_keys = keys

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        """There is no value estimator."""

    def _reduced(self, loss: Tensor, tensordict: TensorDictBase) -> TensorDict:
        """Return the loss, reduced, under its key."""
        loss = self._reduce_loss(loss, tensordict=tensordict)
        return TensorDict({self.out_keys[0]: loss}, loss.shape)
