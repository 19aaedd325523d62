"""What follows for the magnet: tolerances, sorting, shimming, plans, demagnetization."""
