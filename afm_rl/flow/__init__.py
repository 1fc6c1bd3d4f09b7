"""Flows: from the planned action to the action that has its effect."""

from afm_rl.flow.base import Context, Correction, Corrector, Examples, Flow, Window
from afm_rl.flow.cfm import CFMLoss, train_flow
from afm_rl.flow.context_flow import ContextFlow
from afm_rl.flow.effective import effective_action
from afm_rl.flow.l1 import L1Augmentation
from afm_rl.flow.least_squares import LeastSquares
from afm_rl.flow.paper_flow import PaperFlow
from afm_rl.flow.solver import midpoint

__all__ = [
    "CFMLoss",
    "Context",
    "ContextFlow",
    "Correction",
    "Corrector",
    "Examples",
    "Flow",
    "L1Augmentation",
    "LeastSquares",
    "PaperFlow",
    "Window",
    "effective_action",
    "midpoint",
    "train_flow",
]
