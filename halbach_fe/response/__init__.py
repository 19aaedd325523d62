"""The response of readings to magnetizations, its error, and what it costs."""
