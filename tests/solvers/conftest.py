"""The robots of the contract: the PUMA, a planar arm, and a tree of slides and balls."""

from collections.abc import Callable

import numpy as np
import pytest

from robot_ik.robot import Robot, load_robot

PLANAR = """<mujoco model="planar"><compiler angle="radian"/><worldbody>
<body name="upper"><joint name="shoulder" axis="0 0 1" range="-2.8 2.8"/><geom size="0.02"/>
 <body name="lower" pos="0.5 0 0"><joint name="elbow" axis="0 0 1" range="-2.6 2.6"/><geom size="0.02"/>
  <body name="hand" pos="0.4 0 0"><joint name="wrist" axis="0 0 1" range="-2 2"/><geom size="0.02"/>
   <site name="tool" pos="0.2 0 0"/></body></body></body>
<site name="nail" pos="0.3 0.3 0"/>
</worldbody><keyframe><key name="home" qpos="0.2 0.4 0.3"/></keyframe></mujoco>"""

# A carriage on a rail carries a column, on it a ball-jointed arm with a turned hand, and a branch beside it.
TREE = """<mujoco model="tree"><compiler angle="radian"/><worldbody>
<body name="carriage" pos="0 0 0.2" quat="0.9 0.1 -0.2 0.3">
 <joint name="rail" type="slide" axis="1 0 0" range="-0.5 0.5"/>
 <joint name="column" type="slide" axis="0 0 1" range="0 0.6" ref="0.1"/><geom size="0.05"/>
 <body name="arm" pos="0 0 0.3"><joint name="shoulder" type="ball" range="0 1.2" limited="true"/>
  <geom size="0.05"/>
  <body name="forearm" pos="0.4 0 0"><joint name="elbow" pos="0.05 0 0" axis="0 1 0.2" range="-2.2 2.2"/>
   <geom size="0.05"/>
   <body name="hand" pos="0.3 0 0"><joint name="roll" axis="1 0 0"/><geom size="0.05"/>
    <site name="tool" pos="0.1 0 0" quat="0.7 0 0.7 0.1"/></body></body></body>
 <body name="branch" pos="0 0.2 0"><joint name="swing" axis="0 0 1" range="-1 1"/><geom size="0.05"/>
  <site name="lamp" pos="0 0.3 0"/></body>
</body></worldbody></mujoco>"""


@pytest.fixture(scope="session")
def robots(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Robot]:
    """``robots("planar")``: one of the robots of the contract, loaded once."""
    folder = tmp_path_factory.mktemp("robots")
    (folder / "planar.xml").write_text(PLANAR)
    (folder / "tree.xml").write_text(TREE)
    loaded: dict[str, Robot] = {}

    def get(name: str) -> Robot:
        if name not in loaded:
            loaded[name] = load_robot(
                "puma560" if name == "puma560" else folder / f"{name}.xml", tool=TOOLS[name]
            )
        return loaded[name]

    return get


TOOLS = {"puma560": None, "planar": "tool", "tree": "tool"}


@pytest.fixture(scope="session")
def reachable() -> Callable[..., list[np.ndarray]]:
    """``reachable(robot, count)``: the seeded q whose poses make the set that solve rates are measured on."""

    def draw(robot: Robot, count: int, seed: int = 20) -> list[np.ndarray]:
        rng = np.random.default_rng(seed)
        return [robot.sample(rng) for _ in range(count)]

    return draw
