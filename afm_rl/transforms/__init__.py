"""TorchRL transforms."""

from afm_rl.transforms.action_flow import ActionFlowTransform

__all__ = ["ActionFlowTransform"]
