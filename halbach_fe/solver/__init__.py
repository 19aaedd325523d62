"""Magnetostatics: from a magnet to B at points, exactly in vacuum and by finite elements."""
