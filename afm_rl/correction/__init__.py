"""From the planned action to the one that has its effect."""

from afm_rl.correction.action_flow import ActionFlow
from afm_rl.correction.base import Correction, Corrector
from afm_rl.correction.believing import Believer
from afm_rl.correction.classical import ClassicalCorrector
from afm_rl.correction.l1 import L1Augmentation
from afm_rl.correction.least_squares import LeastSquares
from afm_rl.correction.network import AxisNetwork
from afm_rl.correction.pairs import PairCorrector
from afm_rl.correction.paper_flow import PaperFlow
from afm_rl.correction.weights import load_universal

__all__ = [
    "ActionFlow",
    "AxisNetwork",
    "Believer",
    "ClassicalCorrector",
    "Correction",
    "Corrector",
    "L1Augmentation",
    "LeastSquares",
    "PairCorrector",
    "PaperFlow",
    "load_universal",
]
