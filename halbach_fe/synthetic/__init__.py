"""Campaigns that were never measured, made by other programs than the model that they test."""
