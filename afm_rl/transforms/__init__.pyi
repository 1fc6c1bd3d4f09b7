from .action_flow import ActionFlowTransform as ActionFlowTransform
from .guard import Guard as Guard
from .loop import CorrectionLoop as CorrectionLoop
from .policy import ActionFlowPolicy as ActionFlowPolicy
from .regime import RegimeTransform as RegimeTransform
from .simulation import SimulatorState as SimulatorState
