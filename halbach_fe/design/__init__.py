"""Design tasks: tolerances, sorting and shimming of blocks, measurement plans, demagnetization."""
