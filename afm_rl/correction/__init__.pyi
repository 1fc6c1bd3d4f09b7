from .action_flow import ActionFlow as ActionFlow
from .base import Correction as Correction, Corrector as Corrector
from .classical import (
    ClassicalCorrector as ClassicalCorrector,
    L1Augmentation as L1Augmentation,
    LeastSquares as LeastSquares,
)
from .pairs import PairCorrector as PairCorrector
from .paper_flow import PaperFlow as PaperFlow
from .table import Hypothesis as Hypothesis
