"""Scenes: pairs, obstacles that move, attached parts, and checks, compared with MuJoCo."""

import pickle

import mujoco
import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import (
    InvalidObstacleError,
    ModelError,
    OptionError,
    UnknownFrameError,
    UnknownObstacleError,
    UnsupportedGeomError,
)

ROBOTS = ("puma560", "panda", "ur5e", "humanoid", "koch_v11")
BAND = 1e-7
"""m. Nearer than this to contact, MuJoCo and the compiled check may differ."""


def mujoco_is_free(scene, q):
    """Whether ``mj_collision`` finds no contact between parts that can move apart."""
    model = scene.model
    data = scene.data_at(q)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    pairs = {tuple(pair) for pair in scene.pairs.tolist()}
    depth = 0.0
    for contact in range(data.ncon):
        pair = tuple(sorted(data.contact.geom[contact].tolist()))
        if pair in pairs:
            depth = min(depth, float(data.contact.dist[contact]))
    return depth >= 0.0, depth


def random_obstacles(rng, count=6):
    """Obstacles of every kind around a robot."""
    obstacles = [rik.Plane("floor", pose=rik.Pose((0.0, 0.0, -0.4)))]
    for k in range(count):
        position = rng.normal(size=3) * 0.5 + (0.0, 0.0, 0.5)
        pose = rik.Pose(position, rng.normal(size=4))
        size = rng.uniform(0.02, 0.2, 3)
        kind = k % 5
        name = f"obstacle {k}"
        if kind == 0:
            obstacles.append(rik.Box(name, size=tuple(size), pose=pose))
        elif kind == 1:
            obstacles.append(rik.Sphere(name, radius=float(size[0]), pose=pose))
        elif kind == 2:
            obstacles.append(rik.Capsule(name, radius=0.05, length=float(size[0]), pose=pose))
        elif kind == 3:
            obstacles.append(rik.Cylinder(name, radius=0.05, length=float(size[0]), pose=pose))
        else:
            points = rng.normal(size=(40, 3)) * 0.08
            obstacles.append(rik.Mesh(name, vertices=points, pose=pose))
    return obstacles


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("crowded", [False, True])
def test_free_agrees_with_mujoco(name, crowded):
    rng = np.random.default_rng(3)
    robot = rik.load_robot(name)
    scene = rik.Scene(robot, random_obstacles(rng) if crowded else [])
    q = np.array([robot.sample(rng) for _ in range(200)])
    free = scene.free(q)
    for row in range(len(q)):
        expected, depth = mujoco_is_free(scene, q[row])
        distance = scene.clearance(q[row]).distance
        if min(abs(depth), abs(distance)) > BAND:
            assert free[row] == expected, (row, depth, distance)
    assert 0.05 < free.mean() < 0.95


@pytest.mark.parametrize("name", ROBOTS)
def test_distances_equal_those_of_mujoco(name):
    rng = np.random.default_rng(4)
    robot = rik.load_robot(name)
    scene = rik.Scene(robot, random_obstacles(rng))
    q = np.array([robot.sample(rng) for _ in range(60)])
    found = scene.distances(q, reach=0.3)
    for row in range(len(q)):
        distance = scene.clearance(q[row]).distance
        if distance <= 0.0:
            assert found[row] <= 1e-9
        else:
            assert found[row] == pytest.approx(min(distance, 0.3), abs=1e-6)


def test_a_margin_is_kept():
    rng = np.random.default_rng(5)
    robot = rik.load_robot("ur5e")
    scene = rik.Scene(robot, random_obstacles(rng))
    q = np.array([robot.sample(rng) for _ in range(200)])
    free = scene.free(q, margin=0.03)
    clearances = np.array([scene.clearance(row).distance for row in q])
    clear = np.abs(clearances - 0.03) > BAND
    assert (free[clear] == (clearances[clear] > 0.03)).all()


def test_a_moved_obstacle_has_its_new_pose():
    robot = rik.load_robot("puma560")
    tool = robot.forward(robot.home).position
    scene = rik.Scene(
        robot, [rik.Sphere("ball", radius=0.02, pose=rik.Pose(tool + np.array((0, 0, 5.0))))]
    )
    assert scene.free(robot.home)
    model = scene.model
    scene.move("ball", rik.Pose(tool))
    assert scene.model is model
    assert not scene.free(robot.home)
    assert scene.clearance(robot.home).distance < 0.0
    assert "ball" in scene.clearance(robot.home).pair
    assert scene.obstacles[0].pose == rik.Pose(tool)
    scene.move("ball", rik.Pose(tool + np.array((0, 0, 5.0))))
    assert scene.free(robot.home)


def test_an_attached_part_moves_with_the_robot():
    robot = rik.load_robot("panda")
    rng = np.random.default_rng(6)
    part = rik.Box("part", size=(0.04, 0.04, 0.4), pose=rik.Pose((0, 0, 0.22)))
    bare = rik.Scene(robot, [rik.Plane("table", pose=rik.Pose((0, 0, -0.02)))])
    scene = bare.attached(part)
    q = np.array([robot.sample(rng) for _ in range(100)])
    for row in q:
        geom = scene.model.geom("part").id
        wanted = robot.measure(row).compose(part.pose)
        assert scene.data_at(row).geom_xpos[geom] == pytest.approx(wanted.position, abs=1e-9)
    assert (scene.free(q) <= bare.free(q)).all()
    assert scene.free(q).sum() < bare.free(q).sum()
    released = scene.detached("part")
    assert (released.free(q) == bare.free(q)).all()
    laid_down = scene.detached("part", q[0])
    assert laid_down.obstacles[-1].pose == robot.forward(q[0]).compose(part.pose)


def test_parts_that_always_touch_are_reported():
    text = """<mujoco><worldbody>
      <body name="a"><joint name="j1" axis="0 0 1"/><geom size=".1"/>
        <body name="b" pos=".1 0 0"><joint name="j2" axis="0 0 1"/><geom size=".05"/>
          <body name="c" pos=".03 0 0"><joint name="j3" axis="0 0 1"/><geom size=".05"/></body>
      </body></body></worldbody></mujoco>"""
    scene = rik.Scene(rik.load_robot(text))
    assert [item.pair for item in scene.touching] == [("a", "c")]
    line = scene.touching[0].exclude
    assert line == '<exclude body1="a" body2="c"/>'
    cured = text.replace("</mujoco>", f"<contact>{line}</contact></mujoco>")
    assert rik.Scene(rik.load_robot(cured)).touching == ()


def test_pairs_of_the_model_count_even_between_neighbours():
    text = """<mujoco><worldbody>
      <body name="a"><joint name="j1" axis="0 0 1"/><geom name="g" size=".1"/>
        <body name="b" pos=".1 0 0"><joint name="j2" axis="0 0 1"/><geom name="h" size=".05"/>
      </body></body></worldbody><contact><pair geom1="g" geom2="h"/></contact></mujoco>"""
    scene = rik.Scene(rik.load_robot(text))
    assert len(scene.pairs) == 1
    assert scene.clearance([0.0, 0.0]).distance == pytest.approx(-0.05)


def test_a_height_field_is_refused_with_its_name():
    text = """<mujoco><asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/></asset><worldbody>
      <geom name="hills" type="hfield" hfield="h"/>
      <body name="a" pos="0 0 3"><joint name="j1" axis="0 0 1"/><geom size=".1"/></body>
      </worldbody></mujoco>"""
    with pytest.raises(UnsupportedGeomError, match="hills"):
        rik.Scene(rik.load_robot(text))


def test_wrong_obstacles_are_refused():
    robot = rik.load_robot("puma560")
    box = rik.Box("crate")
    for wrong in (
        lambda: rik.Box("crate", size=(0.1, 0.1)),
        lambda: rik.Box("crate", size=(0.1, 0.1, 0.0)),
        lambda: rik.Box("crate", size=(0.1, 0.1, np.nan)),
        lambda: rik.Sphere("ball", radius=-1.0),
        lambda: rik.Box(""),
        lambda: rik.Box("crate", pose=(0, 0, 0)),
        lambda: rik.Mesh("hull"),
        lambda: rik.Mesh("hull", vertices=[[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]),
        lambda: rik.Scene(robot, box),
        lambda: rik.Scene(robot, ["crate"]),
        lambda: rik.Scene(robot, [box, box]),
        lambda: rik.Scene(
            robot, [rik.Box("link3" if "link3" in robot.frames else robot.frames[-1])]
        ),
        lambda: rik.Scene(robot, [box]).move("crate", np.eye(4)),
        lambda: rik.Scene(robot).attached("crate"),
    ):
        with pytest.raises(InvalidObstacleError):
            wrong()
    with pytest.raises(UnknownObstacleError, match="crate"):
        rik.Scene(robot, [box]).move("crat", rik.Pose())
    with pytest.raises(UnknownFrameError):
        rik.Scene(robot).attached(box, "no such frame")
    with pytest.raises(OptionError):
        rik.Scene(robot).free(robot.home, margin=-1.0)
    with pytest.raises(ModelError):
        rik.Scene(robot).free(np.full(robot.nq, np.nan))
    with pytest.raises(ModelError):
        rik.Scene(rik.load_robot(robot.model), [box])


def test_a_robot_inside_an_obstacle_is_not_free():
    robot = rik.load_robot("puma560")
    scene = rik.Scene(robot, [rik.Box("hall", size=(9, 9, 9))])
    rng = np.random.default_rng(1)
    assert not scene.free(np.array([robot.sample(rng) for _ in range(20)])).any()
    assert scene.clearance(robot.home).distance < -1.0


def test_copies_of_a_scene_are_equal_and_independent():
    robot = rik.load_robot("puma560")
    scene = rik.Scene(robot, [rik.Box("crate", pose=rik.Pose((0.5, 0, 0.5)))])
    copy = pickle.loads(pickle.dumps(scene))
    rng = np.random.default_rng(2)
    q = np.array([robot.sample(rng) for _ in range(50)])
    assert (copy.free(q) == scene.free(q)).all()
    copy.move("crate", rik.Pose((9, 9, 9)))
    assert scene.obstacles[0].pose != copy.obstacles[0].pose


def test_many_postures_are_checked_on_all_cores_with_equal_results():
    robot = rik.load_robot("puma560")
    scene = rik.Scene(robot)
    rng = np.random.default_rng(2)
    q = np.array([robot.sample(rng) for _ in range(2000)])
    singles = np.concatenate([scene.free(q[k : k + 100]) for k in range(0, 2000, 100)])
    assert (scene.free(q) == singles).all()


def test_a_model_of_large_hulls_that_share_meshes_agrees_with_mujoco():
    rng = np.random.default_rng(0)
    meshes = []
    for k in range(3):
        points = rng.normal(size=(500, 3))
        points *= rng.uniform(0.02, 0.05, 3) / np.linalg.norm(points, axis=1)[:, None]
        numbers = " ".join(map(str, points.ravel()))
        meshes.append(f'<mesh name="m{k}" vertex="{numbers}"/>')
    body = '<site name="tool"/>'
    for link in range(5, 0, -1):
        geoms = "".join(
            f'<geom type="mesh" mesh="m{k % 3}" pos="0 0 {0.02 * k}"/>' for k in range(8)
        )
        axis = "0 0 1" if link % 2 else "0 1 0"
        body = (
            f'<body name="l{link}" pos="0 0 .2"><joint name="j{link}" axis="{axis}"/>'
            f"{geoms}{body}</body>"
        )
    text = f"<mujoco><asset>{''.join(meshes)}</asset><worldbody>{body}</worldbody></mujoco>"
    robot = rik.load_robot(text)
    scene = rik.Scene(robot, [rik.Box("box", pose=rik.Pose((0.2, 0.2, 0.5)))])
    assert len(scene._tables.block.arrays["vertices"]) < 1600
    q = np.array([robot.sample(rng) for _ in range(100)])
    free = scene.free(q)
    assert 0.1 < free.mean() < 0.95
    for row in range(len(q)):
        expected, depth = mujoco_is_free(scene, q[row])
        if abs(depth) > BAND or expected:
            assert free[row] == expected
