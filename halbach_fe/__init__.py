"""halbach-fe: finite elements and Bayesian inference for permanent-magnet Halbach arrays."""
