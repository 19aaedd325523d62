"""Foundations that all other packages use: error types, safe file access, array types."""
