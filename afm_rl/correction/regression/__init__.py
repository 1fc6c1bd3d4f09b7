"""Bayesian regression over a table of hypotheses."""
