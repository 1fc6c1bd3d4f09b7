"""Start values for what a policy remembers."""

from __future__ import annotations

from tensordict import TensorDictBase
from torchrl.data import Composite
from torchrl.envs import TensorDictPrimer


class ZeroPrimer(TensorDictPrimer):
    """A :class:`TensorDictPrimer` of zeros that also serves batch-unlocked environments.

    The base class fills the batch of the environment; this one fills the batch of the reset.

    Args:
        spec: the entries, without batch dimensions.
    """

    def __init__(self, spec: Composite) -> None:
        super().__init__(spec, default_value=0.0, expand_specs=True)
        self.bare = spec.clone()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Put the entries into a tensordict of any batch shape, where there is no environment."""
        return self._reset_func(tensordict, tensordict)

    def _reset_func(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        batch = tensordict_reset.batch_size  # the environment merges partial resets itself
        for key, leaf in self.bare.items(True, True):
            tensordict_reset.set(key, leaf.zero(batch).to(tensordict_reset.device))
        return tensordict_reset
