"""Figures and HTML pages. The only room that plots."""
