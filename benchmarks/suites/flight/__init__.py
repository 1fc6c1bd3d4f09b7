"""Baseline controllers of quadrotors: geometric control, RAPTOR, an estimate of the mass."""

from flight.geometric import GeometricController
from flight.mass_estimator import MassEstimator
from flight.raptor import Raptor

__all__ = ["GeometricController", "MassEstimator", "Raptor"]
