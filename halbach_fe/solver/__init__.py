"""Magnetostatics: B of a magnet at points, in closed form in vacuum and by finite elements."""
