"""A teleoperator without hardware: it waves the first joint, or moves the tool up and down."""

import importlib
from typing import Any

from wave_teleoperator.config_wave import WaveConfig

__all__ = ["Wave", "WaveConfig"]


def __getattr__(name: str) -> Any:
    if name != "Wave":
        raise AttributeError(name)
    return importlib.import_module("wave_teleoperator.wave").Wave
