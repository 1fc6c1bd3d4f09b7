from ._version import __version__ as __version__
from .transforms.action_flow import ActionFlowTransform as ActionFlowTransform
from .transforms.check_model import check_model as check_model
from .transforms.fault_wrapper import FaultVectorWrapper as FaultVectorWrapper
from .transforms.fault_wrapper import FaultWrapper as FaultWrapper
from .transforms.gymnasium import ActionFlowVectorWrapper as ActionFlowVectorWrapper
from .transforms.gymnasium import ActionFlowWrapper as ActionFlowWrapper
from .transforms.stable_baselines import ActionFlowVecEnv as ActionFlowVecEnv
