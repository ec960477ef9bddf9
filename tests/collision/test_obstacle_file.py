"""Obstacles of an MJCF file: each has the distances of its geom, by MuJoCo."""

import mujoco
import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import InvalidObstacleError, ModelError

FURNITURE = """<mujoco><asset>
<mesh name="wedge" vertex="0 0 0  .3 0 0  0 .2 0  0 0 .25"/></asset><worldbody>
<geom name="floor" type="plane" size="1 1 .1" pos="0 0 -.5"/>
<geom name="picture" type="box" size="9 9 9" contype="0" conaffinity="0"/>
<body name="table" pos=".5 .1 .2" euler="0 0 30"><geom type="box" size=".3 .2 .02"/>
 <geom type="cylinder" size=".02 .2" pos="0 0 -.2"/>
 <body name="lamp" pos="0 0 .1" euler="40 0 0"><geom name="bulb" size=".05"/>
  <geom name="rod" type="capsule" fromto="0 0 0 .1 .1 .1" size=".01"/></body></body>
<geom name="ramp" type="mesh" mesh="wedge" pos="-.6 0 .1" euler="10 20 30"/>
</worldbody></mujoco>"""

PROBE = """<mujoco><worldbody><body name="probe"><joint type="slide"/><geom size=".04"/></body>
</worldbody></mujoco>"""


def write(tmp_path, text):
    path = tmp_path / "scene.xml"
    path.write_text(text)
    return path


def test_each_obstacle_has_the_pose_and_shape_of_its_geom(tmp_path):
    obstacles = rik.load_obstacles(write(tmp_path, FURNITURE))
    names = [obstacle.name for obstacle in obstacles]
    assert names == ["floor", "ramp", "table", "table 2", "bulb", "rod"]
    robot = rik.load_robot(PROBE)
    # The same sphere among the geoms of the file, compiled by MuJoCo itself.
    probe = '<body name="probe" mocap="true"><geom name="probe" size=".04"/></body></worldbody>'
    model = mujoco.MjModel.from_xml_string(FURNITURE.replace("</worldbody>", probe))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(3)
    solid = [g for g in range(model.ngeom) if model.geom_contype[g] and g != model.geom("probe").id]
    assert len(solid) == len(obstacles)
    for obstacle, geom in zip(obstacles, solid, strict=True):
        for _ in range(5):
            position = rng.uniform(-0.6, 0.6, 3)
            data.mocap_pos[0] = position
            mujoco.mj_kinematics(model, data)
            expected = mujoco.mj_geomDistance(model, data, model.geom("probe").id, geom, 9.0, None)
            # The robot's sphere is at the origin, so the obstacle is moved instead.
            pose = rik.Pose(obstacle.pose.position - position, obstacle.pose.wxyz)
            scene = rik.Scene(robot, [obstacle])
            scene.move(obstacle.name, pose)
            assert scene.clearance(robot.home).distance == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "no geom"),
        ("<geom size='.1' contype='0' conaffinity='0'/>", "no geom"),
        ("<body name='arm'><joint/><geom size='.1'/></body>", "arm"),
        ("<geom name='egg' type='ellipsoid' size='.1 .1 .2'/>", "egg"),
    ],
)
def test_a_file_without_valid_obstacles_is_refused(text, named, tmp_path):
    file = write(tmp_path, f"<mujoco><worldbody>{text}</worldbody></mujoco>")
    with pytest.raises(InvalidObstacleError, match=named):
        rik.load_obstacles(file)


@pytest.mark.parametrize(
    "text",
    [
        "no XML",
        "<mujoco><worldbody><geom size='0'/></worldbody></mujoco>",
        "<mujoco><worldbody><geom size='.1' pos='nan 0 0'/></worldbody></mujoco>",
        "<mujoco><worldbody><geom size='1e400'/></worldbody></mujoco>",
    ],
)
def test_a_file_that_mujoco_cannot_read_is_refused(text, tmp_path):
    with pytest.raises(ModelError):
        rik.load_obstacles(write(tmp_path, text))


def test_a_missing_file_is_named_in_the_error(tmp_path):
    with pytest.raises(ModelError, match=r"there is no scene file .*nowhere\.xml"):
        rik.load_obstacles(tmp_path / "nowhere.xml")
