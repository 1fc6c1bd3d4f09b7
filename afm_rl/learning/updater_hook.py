"""An updater as a hook of TorchRL's collectors and trainers, which are slow to import."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.trainers import Trainer, TrainerHookBase

from afm_rl.errors import ConfigurationError, check_instance
from afm_rl.learning.updater import Updater
from afm_rl.spaces.keys import as_key


class UpdaterHook(TrainerHookBase):
    """An updater that learns from the batches of a collector or a trainer.

    Give it to a collector as ``postproc`` (or ``post_collect_hook``), or to a trainer with
    :meth:`register`. Either way it learns from every transition of a batch ``(*B, T)`` once,
    the oldest first, and adds the losses of the model. A planner that shares the model uses the
    update from the next batch on; if a batch has one frame per environment, this is the next
    step.

    Args:
        updater: updater that learns from one transition per mission at a time.
        loss_key: key of the losses ``(*B, T)``.

    Raises:
        ConfigurationError: for a batch without a time dimension.

    >>> from tensordict import TensorDict
    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.learning import GaussianNLLLoss
    >>> hook = UpdaterHook(Updater(GaussianNLLLoss(Dubins())))
    >>> still = torch.zeros(2, 7, 3)
    >>> td = TensorDict({"observation": still, "action": torch.ones(2, 7, 2)}, [2, 7])
    >>> hook(td.set(("next", "observation"), still))["updater_loss"].shape
    torch.Size([2, 7])
    """

    def __init__(self, updater: Updater, loss_key: NestedKey = "updater_loss") -> None:
        self.updater = check_instance("updater", updater, Updater)
        self.loss_key = as_key(loss_key)
        self._started = False

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Learn from a batch ``(*B, T)``; return it with the losses."""
        if not batch.batch_dims:
            raise ConfigurationError(
                f"updater: got a batch of shape {tuple(batch.shape)}; expected (*B, T), T steps"
            )
        steps = batch.unbind(-1)
        if not self._started:
            self.updater.start(steps[0])
            self._started = True
        losses = [self.updater(step)["loss"] for step in steps]
        return batch.set(self.loss_key, torch.stack(losses, -1))

    def register(self, trainer: Trainer, name: str = "updater") -> None:
        """Let a trainer call it with every batch collected, and store it with its checkpoints."""
        trainer.register_op("batch_process", self)
        trainer.register_module(name, self)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the updater, its model included."""
        return {"updater": self.updater.state_dict(), "started": self._started}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.updater.load_state_dict(state_dict["updater"])
        self._started = state_dict["started"]
