"""The inference of block magnetizations from measurements."""
