"""Runs of ``reach`` on virtual time, and models of arms that are not bundled."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from robot_ik.commands.reach import Reach
from robot_ik.commands.reach_report import ReachReport
from robot_ik.goals import Goal
from robot_ik.workcell import vision
from robot_ik.workcell.scene import Scene, scene_for

UR = """
<mujoco model="urlike"><compiler angle="radian"/><worldbody>
<body name="base"><geom type="cylinder" size=".06 .05"/>
<body name="shoulder" pos="0 0 .16"><joint name="pan" axis="0 0 1" range="-6.28 6.28"/>
 <geom type="cylinder" size=".05 .06"/>
<body name="upper" pos="0 .13 0"><joint name="lift" axis="0 1 0" range="-3.14 3.14"/>
 <geom type="capsule" fromto="0 0 0 0 0 .42" size=".045"/>
<body name="fore" pos="0 -.12 .42"><joint name="elbow" axis="0 1 0" range="-2.8 2.8"/>
 <geom type="capsule" fromto="0 0 0 0 0 .39" size=".04"/>
<body name="w1" pos="0 0 .39"><joint name="wrist1" axis="0 1 0" range="-3.14 3.14"/>
 <geom type="cylinder" size=".035 .04" zaxis="0 1 0"/>
<body name="w2" pos="0 .1 0"><joint name="wrist2" axis="0 0 1" range="-3.14 3.14"/>
 <geom type="cylinder" size=".035 .04"/>
<body name="w3" pos="0 0 .09"><joint name="wrist3" axis="0 1 0" range="-6.28 6.28"/>
 <geom type="cylinder" size=".03 .02" zaxis="0 1 0"/>
 <site name="tool" pos="0 .08 0" quat=".7071 -.7071 0 0"/>
</body></body></body></body></body></body></body></worldbody>
<keyframe><key name="home" qpos="0 -.5 1.2 .6 -1.57 0"/></keyframe></mujoco>
"""

PLANAR = """
<mujoco model="planar3"><worldbody>
<body name="a"><joint name="j1" axis="0 0 1" range="-170 170"/>
 <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>
<body name="b" pos=".3 0 0"><joint name="j2" axis="0 0 1" range="-150 150"/>
 <geom type="capsule" fromto="0 0 0 .25 0 0" size=".02"/>
<body name="c" pos=".25 0 0"><joint name="j3" axis="0 0 1" range="-150 150"/>
 <geom type="capsule" fromto="0 0 0 .15 0 0" size=".02"/>
 <site name="tip" pos=".15 0 0"/></body></body></body></worldbody></mujoco>
"""

# Four servos and two fingers on slides.
DESK = """
<mujoco model="desk4"><worldbody>
<body name="base" pos="0 0 .05"><geom type="box" size=".04 .04 .05"/>
<body name="turn" pos="0 0 .05"><joint name="waist" axis="0 0 1" range="-180 180"/>
 <geom type="cylinder" size=".03 .02"/>
<body name="upper" pos="0 0 .03"><joint name="shoulder" axis="0 1 0" range="-110 110"/>
 <geom type="capsule" fromto="0 0 0 0.02 0 .13" size=".015"/>
<body name="fore" pos=".024 0 .128"><joint name="elbow" axis="0 1 0" range="-90 90"/>
 <geom type="capsule" fromto="0 0 0 .124 0 0" size=".014"/>
<body name="hand" pos=".124 0 0"><joint name="wrist" axis="0 1 0" range="-100 115"/>
 <geom type="capsule" fromto="0 0 0 .1 0 0" size=".012"/>
 <body name="left" pos=".1 0 0"><joint name="left_finger" type="slide" axis="0 1 0" range="0 .02"/>
  <geom type="box" size=".02 .004 .01" pos="0.02 .01 0"/></body>
 <body name="right" pos=".1 0 0">
  <joint name="right_finger" type="slide" axis="0 -1 0" range="0 .02"/>
  <geom type="box" size=".02 .004 .01" pos="0.02 -.01 0"/></body>
 <site name="ee" pos=".126 0 0"/>
</body></body></body></body></body></worldbody></mujoco>
"""


def two_arms(links: list[tuple[str, float]]) -> str:
    """A trunk with two equal arms: the axis of each joint, and the length of the link behind it."""

    def arm(name: str, y: float) -> str:
        text = ""
        before = ""
        for k, (axis, length) in enumerate(links):
            place = before or f"0 {y} .5"
            text += f"""<body pos="{place}"><joint name="{name}{k}" axis="{axis}" range="-120 120"/>
             <geom type="capsule" fromto="0 0 0 0 0 {length}" size=".03"/>"""
            before = f"0 0 {length}"
        return (
            f'{text}<site name="{name}_hand" pos="0 0 {links[-1][1] + 0.05}"/>'
            + "</body>" * len(links)
        )

    trunk = '<body name="trunk"><geom type="box" size=".08 .15 .25" pos="0 0 .25"/>'
    both = arm("left", 0.2) + arm("right", -0.2)
    return f'<mujoco model="two"><worldbody>{trunk}{both}</body></worldbody></mujoco>'


X = "1 0 0"
Y = "0 1 0"
Z = "0 0 1"
# Both were given scenes in which the arm's own markers covered the target.
SEVEN = [(Y, 0.117), (Z, 0.06), (Z, 0.253), (Y, 0.278), (Y, 0.232), (Y, 0.186), (X, 0.254)]
THREE = [(Z, 0.175), (X, 0.2), (Z, 0.087)]


def seen_smaller(*of: Any, **rest: Any) -> Scene:
    """Return the scene with pictures of half the size, which take a third of the time."""
    scene = scene_for(*of, **rest)
    width, height = scene.intrinsics.size
    return replace(scene, intrinsics=scene.intrinsics.scaled(width // 2, height // 2))


@pytest.fixture
def full_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures as large as users see them, for claims about accuracy."""
    monkeypatch.setattr(vision, "scene_for", scene_for)


def goal_numbers(goal: Goal) -> tuple[float, ...]:
    """Return a goal as the numbers of ``--goal``."""
    numbers = goal.target.position.tolist()
    if goal.weights[1] > 0.0:
        numbers += goal.target.wxyz.tolist()
    return tuple(numbers)


def run_reach(
    fault: Iterable[str] = (), *, goal: Goal | None = None, **options: Any
) -> ReachReport:
    """Run ``reach`` on servos in this process and virtual time."""
    if goal is not None:
        options["goal"] = goal_numbers(goal)
    return Reach(**{"bus": "sim", "fault": tuple(fault), **options}).run()


@pytest.fixture
def reach() -> Callable[..., ReachReport]:
    """``reach("stuck:joint2", …) -> ReachReport``, with the options of the command as keywords."""

    def run(*fault: str, **options: Any) -> ReachReport:
        return run_reach(fault, **options)

    return run


@pytest.fixture(scope="session")
def healthy() -> ReachReport:
    """One run without faults, in full pictures. It must not be changed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vision, "scene_for", scene_for)
        return run_reach()


@pytest.fixture(scope="session")
def arms(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Model files by name: ``ur`` has six axes, ``planar`` three, ``desk`` four and two fingers."""
    folder = tmp_path_factory.mktemp("arms")
    files = {}
    texts = {"two_arms": two_arms(SEVEN), "two_arms_of_three_joints": two_arms(THREE)}
    for name, text in {"ur": UR, "planar": PLANAR, "desk": DESK, **texts}.items():
        files[name] = folder / f"{name}.xml"
        files[name].write_text(text)
    return files
