"""Bayesian update of the block magnetizations. Sees arrays and labels only."""
