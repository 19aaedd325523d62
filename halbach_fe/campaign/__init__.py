"""Synthetic measurements: a magnet with its errors, and its field by other people's programs."""
