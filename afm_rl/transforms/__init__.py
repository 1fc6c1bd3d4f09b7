"""TorchRL transforms."""

from afm_rl.transforms.action_flow import ActionFlowTransform
from afm_rl.transforms.regime import RegimeTransform

__all__ = ["ActionFlowTransform", "RegimeTransform"]
