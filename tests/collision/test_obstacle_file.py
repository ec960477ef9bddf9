"""Obstacles of an MJCF file: MuJoCo measures the same distances to both."""

import mujoco
import numpy as np
import pytest

import robot_ik as rik
from robot_ik.collision.obstacle_file import read_obstacles
from robot_ik.errors import InvalidObstacleError, ModelError

SHAPES = """<mujoco><asset>
  <mesh name="wedge" vertex="0 0 0  .3 0 0  0 .2 0  0 0 .1  .1 .1 .1"/></asset><worldbody>
  <geom name="floor" type="plane" size="1 1 .1" pos="0 0 -1" euler="5 10 0"/>
  <geom name="box" type="box" size=".1 .2 .3" pos="1 0 0" euler="10 20 30"/>
  <geom name="ball" size=".2" pos="0 1 0"/>
  <geom name="rod" type="capsule" size=".05 .3" pos="-1 0 0" euler="40 0 10"/>
  <geom name="ghost" size=".4" contype="0" conaffinity="0"/>
  <body pos="0 -1 .2" euler="0 30 0"><geom name="can" type="cylinder" size=".1 .2" pos=".1 0 0"/>
    <geom type="mesh" mesh="wedge" pos="0 0 .8" euler="0 0 50"/></body>
  </worldbody></mujoco>"""

PROBE = """<mujoco><worldbody><body name="probe" pos="{} {} {}"><joint name="j"/>
  <geom size=".01"/></body></worldbody></mujoco>"""


def test_the_obstacles_are_where_the_geoms_are(tmp_path):
    file = tmp_path / "scene.xml"
    file.write_text(SHAPES)
    obstacles = read_obstacles(file)
    assert [item.name for item in obstacles[:4]] == ["floor", "box", "ball", "rod"]
    assert len(obstacles) == 6
    model = mujoco.MjModel.from_xml_string(SHAPES)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    solid = [g for g in range(model.ngeom) if model.geom_contype[g]]
    rng = np.random.default_rng(1)
    for _ in range(20):
        point = rng.uniform(-2.0, 2.0, 3)
        robot = rik.load_robot(PROBE.format(*point))
        spec = mujoco.MjSpec.from_string(SHAPES)
        spec.worldbody.add_geom(name="probe", size=[0.01, 0.0, 0.0], pos=point)
        judge = spec.compile()
        state = mujoco.MjData(judge)
        mujoco.mj_kinematics(judge, state)
        probe = judge.geom("probe").id
        for geom, obstacle in zip(solid, obstacles, strict=True):
            # The world's geoms come first, so the probe moves the others by one.
            other = geom + 1 if geom >= probe else geom
            expected = mujoco.mj_geomDistance(judge, state, probe, other, 10.0, None)
            distance = rik.Scene(robot, [obstacle]).clearance(robot.home).distance
            assert distance == pytest.approx(expected, abs=1e-6)


def test_files_that_hold_no_obstacles_are_refused(tmp_path):
    file = tmp_path / "scene.xml"
    egg = '<geom type="ellipsoid" size=".1 .2 .3"/>'
    file.write_text(f"<mujoco><worldbody>{egg}</worldbody></mujoco>")
    with pytest.raises(InvalidObstacleError, match="ellipsoid"):
        read_obstacles(file)
    with pytest.raises(ModelError):
        read_obstacles(tmp_path / "nothing.xml")
