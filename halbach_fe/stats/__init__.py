"""Statistics on plain arrays: Gaussian updates, noise, sampling and its convergence."""
