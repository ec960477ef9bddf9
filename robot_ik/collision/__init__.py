"""Collisions: scenes, distances and the condition that a posture must be free."""

LARGEST_MARGIN = 10.0
"""m. Largest margin of a condition on collisions."""

DEFAULT_MARGIN = 0.005
"""m. More than the error of a calibrated small arm."""
