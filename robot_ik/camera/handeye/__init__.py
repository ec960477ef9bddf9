"""Where a camera is: on the arm, beside it, or in the world.

``solve`` answers AX = XB from views at known joint angles: ``start`` finds a first answer and whether
there is one, ``model`` predicts the pixels with derivatives, ``noise`` learns how well the arm knows its
own poses.  ``places`` locates a camera from a board at a known place and keeps places in files;
``rotation_average`` serves all of them.
"""

from typing import TYPE_CHECKING

from robot_ik.camera.on_demand import on_demand

if TYPE_CHECKING:
    from robot_ik.camera.handeye.model import HandEyeSample, Mounting
    from robot_ik.camera.handeye.solve import HandEye, ViewResidual, solve_handeye

__all__ = [
    "HandEye",
    "HandEyeSample",
    "Mounting",
    "ViewResidual",
    "solve_handeye",
]

__getattr__ = on_demand(
    __name__,
    {
        "model": ("HandEyeSample", "Mounting"),
        "solve": ("HandEye", "ViewResidual", "solve_handeye"),
    },
)
