"""What is installed on this machine: MuJoCo and its OpenGL back ends, versions of packages."""

from __future__ import annotations

import os
from importlib import metadata
from types import ModuleType

from robot_ik.errors import DISTRIBUTION, RobotIkError

_MESA = "libgl1 libgl1-mesa-dri"

GL_PACKAGES = {"egl": "libegl1 libgl1", "osmesa": "libosmesa6", "glfw": _MESA, "glx": _MESA}
"""Back end of ``MUJOCO_GL``: packages of Debian and Ubuntu that install it."""

OPENCV_WHEELS = (
    "opencv-contrib-python-headless",
    "opencv-python-headless",
    "opencv-contrib-python",
    "opencv-python",
)
"""Distributions that install ``cv2``, best first."""


def graphics_error(value: str, reason: BaseException | str) -> RobotIkError:
    """The error for ``MUJOCO_GL=value`` when MuJoCo cannot be imported with it."""
    name = value.lower().strip()
    if isinstance(reason, BaseException):
        reason = f"{type(reason).__name__}: {reason}"
    apt = (
        f"or install its library: sudo apt-get install --no-install-recommends {GL_PACKAGES[name]}"
        if name in GL_PACKAGES
        else f"or choose one of: {', '.join(GL_PACKAGES)}"
    )
    return RobotIkError(
        f"MUJOCO_GL={value} is set, and MuJoCo cannot be imported with it ({reason})",
        hint=f"robot_ik needs no OpenGL: unset MUJOCO_GL\n{apt}\nlook closer with: robot-ik doctor",
    )


def import_mujoco() -> ModuleType:
    """The ``mujoco`` module, or an error that says what is wrong with this machine.

    Costs nothing beyond the import itself.

    Raises:
        RobotIkError: ``MUJOCO_GL`` names a back end that is not there, MuJoCo is not installed, or
            only an empty shell of it is (an upgrade across version 4 can leave one).
    """
    try:
        import mujoco
    except (
        Exception
    ) as reason:  # MuJoCo fails here with AttributeError, RuntimeError, ImportError, …
        value = os.environ.get("MUJOCO_GL", "")
        if value and not isinstance(reason, ModuleNotFoundError):
            raise graphics_error(value, reason) from reason
        raise RobotIkError(
            f"MuJoCo cannot be imported ({type(reason).__name__}: {reason})",
            hint="install it with: pip install mujoco\nlook closer with: robot-ik doctor",
        ) from reason
    if not hasattr(mujoco, "MjModel"):
        raise RobotIkError(
            "the installed mujoco package has no MjModel, because two versions were mixed",
            hint="repair: pip uninstall -y mujoco mujoco-core mujoco-studio && pip install mujoco",
        )
    return mujoco


def version_of(package: str) -> str:
    """Installed version of a distribution, or an empty string."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def installed_versions() -> dict[str, str]:
    """Return the versions of this distribution and of its main dependencies."""
    opencv = next((name for name in OPENCV_WHEELS if version_of(name)), "opencv")
    names = (DISTRIBUTION, "mujoco", opencv, "numba", "numpy", "dynamixel-sdk")
    return {name: version_of(name) for name in names}
