"""Where a model and a measurement disagree, and which missing effect explains it."""
