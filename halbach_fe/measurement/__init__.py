"""Measured maps and blocks: their files, the instrument, and readings as linear functions of B."""
