"""The update of a magnet by its measurements."""
