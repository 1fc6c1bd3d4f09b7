from .action_flow import ActionFlow as ActionFlow
from .base import Correction as Correction, Corrector as Corrector
from .classical import (
    ClassicalCorrector as ClassicalCorrector,
    L1Augmentation as L1Augmentation,
    LeastSquares as LeastSquares,
)
from .hypotheses import HYPOTHESES as HYPOTHESES, Hypothesis as Hypothesis
from .network import AxisNetwork as AxisNetwork, load_universal as load_universal
from .pairs import PairCorrector as PairCorrector
from .paper_flow import PaperFlow as PaperFlow
from .regression.corrector import RegressionFlow as RegressionFlow
