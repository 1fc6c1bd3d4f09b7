"""TorchRL transforms, and the same correction as a policy and as gymnasium's wrappers."""

from afm_rl.transforms.action_flow import ActionFlowTransform
from afm_rl.transforms.guard import Guard
from afm_rl.transforms.policy import ActionFlowPolicy
from afm_rl.transforms.regime import RegimeTransform

__all__ = ["ActionFlowPolicy", "ActionFlowTransform", "Guard", "RegimeTransform"]
