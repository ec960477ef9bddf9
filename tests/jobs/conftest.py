"""Arms of other people, and runs of the job on virtual time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from robot_ik.jobs import vision
from robot_ik.jobs.reach import ReachReport, ReachRequest, run_reach
from robot_ik.jobs.robot_setup import Rehearsal
from robot_ik.jobs.scene import Scene, scene_for
from robot_ik.jobs.script import ScriptReport, ScriptRequest, parse_script, run_script

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
 <body name="right" pos=".1 0 0"><joint name="right_finger" type="slide" axis="0 -1 0" range="0 .02"/>
  <geom type="box" size=".02 .004 .01" pos="0.02 -.01 0"/></body>
 <site name="ee" pos=".126 0 0"/>
</body></body></body></body></body></worldbody></mujoco>
"""


def two_arms(links: list[tuple[str, float]]) -> str:
    """A trunk with two equal arms: the axis of each joint, and the length of the link behind it."""

    def arm(name: str, y: float) -> str:
        text, before = "", ""
        for k, (axis, length) in enumerate(links):
            place = before or f"0 {y} .5"
            text += f"""<body pos="{place}"><joint name="{name}{k}" axis="{axis}" range="-120 120"/>
             <geom type="capsule" fromto="0 0 0 0 0 {length}" size=".03"/>"""
            before = f"0 0 {length}"
        return f'{text}<site name="{name}_hand" pos="0 0 {links[-1][1] + 0.05}"/>' + "</body>" * len(links)

    trunk = '<body name="trunk"><geom type="box" size=".08 .15 .25" pos="0 0 .25"/>'
    both = arm("left", 0.2) + arm("right", -0.2)
    return f'<mujoco model="two"><worldbody>{trunk}{both}</body></worldbody></mujoco>'


X, Y, Z = "1 0 0", "0 1 0", "0 0 1"
# Both were given scenes in which the arm's own markers covered the target.
SEVEN = [(Y, 0.117), (Z, 0.06), (Z, 0.253), (Y, 0.278), (Y, 0.232), (Y, 0.186), (X, 0.254)]
THREE = [(Z, 0.175), (X, 0.2), (Z, 0.087)]


def seen_smaller(*of: Any, **rest: Any) -> Scene:
    """The scene before a camera with half as many pixels a side: its pictures take a third of the time."""
    scene = scene_for(*of, **rest)
    width, height = scene.intrinsics.size
    return replace(scene, intrinsics=scene.intrinsics.scaled(width // 2, height // 2))


@pytest.fixture(scope="module", autouse=True)  # and no longer: other folders look at what users see
def _light_pictures() -> Iterator[None]:
    """Pictures of half the size."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vision, "scene_for", seen_smaller)
        yield


@pytest.fixture
def full_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """As large as users see them: for claims of how exact they are, and to compare with ``healthy``."""
    monkeypatch.setattr(vision, "scene_for", scene_for)


@pytest.fixture
def reach() -> Callable[..., ReachReport]:
    """``reach(rehearse={...}, **request)``: the job on servos in this process and virtual time."""

    def run(rehearse: dict[str, Any] | None = None, **request: Any) -> ReachReport:
        request = {"bus": "sim", "rehearsal": Rehearsal(**(rehearse or {})), **request}
        return run_reach(ReachRequest(**request))

    return run


@pytest.fixture(scope="session")
def healthy() -> ReachReport:
    """One run with nothing wrong, in full pictures; not to be changed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vision, "scene_for", scene_for)
        return run_reach(ReachRequest(bus="sim"))


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


@pytest.fixture
def play() -> Callable[..., ScriptReport]:
    """``play(steps in TOML, **request)``."""

    def play(steps: str, head: str = "", **request: object) -> ScriptReport:
        script = parse_script(f'schema = 1\nname = "trial"\n{head}\n{steps}', "trial.toml")
        return run_script(script, ScriptRequest(**request))  # type: ignore[arg-type]

    return play
