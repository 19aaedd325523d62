"""Synthetic measurement campaigns, computed by programs other than the model that they test."""
