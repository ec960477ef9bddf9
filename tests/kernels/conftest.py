"""Random kinematic trees: any mixture of joints, offsets, reference angles and fixed bodies."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import strategies as st

from robot_ik.robot import Robot, load_robot

NUMBER = st.integers(-600, 600).map(lambda i: i / 1000)
VECTOR = st.tuples(NUMBER, NUMBER, NUMBER)
# Axes and quaternions of any length except zero. MuJoCo and the tree normalise them.
AXIS = VECTOR.filter(lambda v: sum(x * x for x in v) > 1e-4)
QUATERNION = st.tuples(NUMBER, NUMBER, NUMBER, NUMBER).filter(
    lambda v: sum(x * x for x in v) > 1e-4
)
MIXTURES = [
    [],
    ["hinge"],
    ["hinge"],
    ["slide"],
    ["ball"],
    ["hinge", "hinge"],
    ["slide", "hinge"],
    ["slide", "ball"],
]


def _text(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)


@st.composite
def _joint(draw: Any, kind: str, name: str) -> str:
    text = f'<joint name="{name}" type="{kind}" pos="{_text(draw(VECTOR))}"'
    if kind == "ball":
        return text + f' limited="{draw(st.sampled_from(["true", "false"]))}" range="0 0.9"/>'
    text += f' axis="{_text(draw(AXIS))}" ref="{draw(NUMBER):g}"'
    return text + (' range="-0.7 0.6"/>' if draw(st.booleans()) else "/>")


@dataclass(frozen=True)
class RandomModel:
    """MJCF text, and the joints that may move (None: all)."""

    xml: str
    joints: tuple[str, ...] | None


@st.composite
def random_models(draw: Any) -> RandomModel:
    """One to five bodies, each attached to an earlier body or the world, with a site each."""
    count = draw(st.integers(1, 5))
    parents = [draw(st.integers(-1, i - 1)) for i in range(count)]
    names: list[str] = []
    bodies: list[str] = []
    for i in range(count):
        kinds = (
            ["free"]
            if parents[i] < 0 and draw(st.integers(0, 5)) == 0
            else draw(st.sampled_from(MIXTURES))
        )
        if i == count - 1 and not names and not kinds:
            kinds = ["hinge"]
        joints = ""
        for kind in kinds:
            names.append(f"j{len(names)}")
            joints += (
                f'<freejoint name="{names[-1]}"/>'
                if kind == "free"
                else draw(_joint(kind, names[-1]))
            )
        pose = f'pos="{_text(draw(VECTOR))}" quat="{_text(draw(QUATERNION))}"'
        site = f'<site name="s{i}" pos="{_text(draw(VECTOR))}" quat="{_text(draw(QUATERNION))}"/>'
        bodies.append(f'<body name="b{i}" {pose}>{joints}<geom size="0.1"/>{site}%s</body>')
    for i in reversed(range(count)):
        inside = "".join(bodies[k] for k in range(i + 1, count) if parents[k] == i)
        bodies[i] = bodies[i] % inside
    world = "".join(bodies[i] for i in range(count) if parents[i] < 0)
    xml = f'<mujoco><compiler angle="radian"/><worldbody>{world}</worldbody></mujoco>'
    moving = (
        draw(st.lists(st.sampled_from(names), min_size=1, unique=True))
        if draw(st.booleans())
        else None
    )
    return RandomModel(xml, tuple(moving) if moving else None)


@pytest.fixture(scope="session")
def any_model() -> st.SearchStrategy[RandomModel]:
    return random_models()


@pytest.fixture(scope="session")
def load_xml(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Robot]:
    """``load_xml(text, joints)``: a robot of MJCF text."""
    folder = tmp_path_factory.mktemp("models")

    def load(xml: str, joints: Any = None, tool: str | None = None) -> Robot:
        path: Path = folder / "model.xml"
        path.write_text(xml)
        return load_robot(path, joints=joints, tool=tool)

    return load


@pytest.fixture(scope="session")
def draw_q() -> Callable[[Robot, np.random.Generator], np.ndarray]:
    """``draw_q(robot, rng)``: any q, also outside the limits, with quaternions of any length."""

    def draw(robot: Robot, rng: np.random.Generator) -> np.ndarray:
        return rng.normal(size=robot.nq)

    return draw


@pytest.fixture(scope="session")
def mujoco_at() -> Callable[[Robot, np.ndarray], mujoco.MjData]:
    """``mujoco_at(robot, q)``: MuJoCo's kinematics, with the frozen joints at their values."""

    def at(robot: Robot, q: np.ndarray) -> mujoco.MjData:
        data = mujoco.MjData(robot.model)
        data.qpos[:] = robot.qpos(q)
        mujoco.mj_kinematics(robot.model, data)
        mujoco.mj_comPos(robot.model, data)
        return data

    return at


@pytest.fixture(scope="session")
def dof_addresses() -> Callable[[Robot], np.ndarray]:
    """Return the addresses of the robot's dq in MuJoCo's qvel."""

    def find(robot: Robot) -> np.ndarray:
        model = robot.model
        dofs = []
        for joint in robot.joints:
            first = int(model.joint(joint).dofadr[0])
            dofs += range(first, first + {0: 6, 1: 3, 2: 1, 3: 1}[int(model.joint(joint).type[0])])
        return np.array(dofs)

    return find
