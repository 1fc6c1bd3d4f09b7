"""The quadrotor that follows references: own equations, or RotorPy's."""
