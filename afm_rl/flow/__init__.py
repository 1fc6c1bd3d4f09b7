"""The flow: experts, network, prior and training."""

from afm_rl.flow.experts import Experts, Rows, fit_experts
from afm_rl.flow.network import AxisNetwork
from afm_rl.flow.prior import draw_examples
from afm_rl.flow.solver import midpoint
from afm_rl.flow.training import CFMLoss, train_flow
from afm_rl.flow.weights import load_universal

__all__ = [
    "AxisNetwork",
    "CFMLoss",
    "Experts",
    "Rows",
    "draw_examples",
    "fit_experts",
    "load_universal",
    "midpoint",
    "train_flow",
]
