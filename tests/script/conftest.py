"""Fixtures of scripted runs: those of the workcell."""

from tests.workcell.conftest import _light_pictures, arms, full_pictures, healthy, play, reach

__all__ = ["_light_pictures", "arms", "full_pictures", "healthy", "play", "reach"]
