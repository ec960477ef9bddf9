"""Measurements of live augmented reality."""
