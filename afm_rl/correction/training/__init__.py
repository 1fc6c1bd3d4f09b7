"""How the flow is trained: on regimes without a robot, and refined on one."""

from afm_rl.correction.training.prior import draw_examples
from afm_rl.correction.training.refine import CFMLoss, train_flow

__all__ = ["CFMLoss", "draw_examples", "train_flow"]
