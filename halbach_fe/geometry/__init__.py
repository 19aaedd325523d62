"""The magnet that a study describes, as shapes in space."""
