"""Empty modules for packages that LeRobot's utilities import but do not use for motors.

With them the unmodified motor files of LeRobot run without PyTorch and two other packages.
"""

import sys
import types


def _anything(name: str) -> type:
    return type(name, (), {})


for name in ("torch", "accelerate", "datasets", "datasets.utils", "datasets.utils.logging"):
    module = types.ModuleType(name)
    module.__getattr__ = _anything  # type: ignore[method-assign]
    sys.modules[name] = module
