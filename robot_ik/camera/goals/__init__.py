"""What is seen becomes what is wanted: markers and bodies as a source of goals.

``marker_source`` is the source; ``sight`` weighs one sight, ``one_euro`` calms what is shown (the filter
over time is ``camera/filter.py``), ``lost`` says what happens when nothing is seen, ``latest`` looks
beside the control loop, ``latency`` measures how old a goal is.
"""

from typing import TYPE_CHECKING

from robot_ik.camera.on_demand import on_demand

if TYPE_CHECKING:
    from robot_ik.camera.goals.marker_source import MarkerGoalSource

__all__ = [
    "MarkerGoalSource",
]

__getattr__ = on_demand(
    __name__,
    {
        "marker_source": ("MarkerGoalSource",),
    },
)
