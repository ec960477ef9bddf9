"""LeRobot's utilities import PyTorch and two more at their top and use none of it for motors.

Empty modules in their place let its own, unmodified motor files run without the gigabytes.
"""

import sys
import types


def _anything(name: str) -> type:
    return type(name, (), {})


for name in ("torch", "accelerate", "datasets", "datasets.utils", "datasets.utils.logging"):
    module = types.ModuleType(name)
    module.__getattr__ = _anything  # type: ignore[method-assign]
    sys.modules[name] = module
