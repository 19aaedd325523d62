"""Find which missing effects explain the disagreement between a model and a measured map."""
