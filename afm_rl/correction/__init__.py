"""From the planned action to the one that has its effect."""

from afm_rl.correction.action_flow import ActionFlow
from afm_rl.correction.base import Correction, Corrector
from afm_rl.correction.believing import Believer
from afm_rl.correction.classical import ClassicalCorrector, L1Augmentation, LeastSquares
from afm_rl.correction.network import AxisNetwork, load_universal
from afm_rl.correction.pairs import PairCorrector
from afm_rl.correction.paper_flow import PaperFlow

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
