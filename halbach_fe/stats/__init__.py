"""Statistics on plain arrays: Gaussian updates, noise covariances, sampling and convergence."""
