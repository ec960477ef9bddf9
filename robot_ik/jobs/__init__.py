"""Whole jobs built from the parts: what the commands run."""
