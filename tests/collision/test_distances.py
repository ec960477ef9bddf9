"""Bounds of the compiled distance against ``mj_geomDistance``, and filters against brute force."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robot_ik as rik
from robot_ik.collision.distances import capsule_around
from robot_ik.kernels import collision

KINDS = ("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
FARTHEST = 10.0


def two_geoms(kinds, sizes, quats):
    """A robot of one geom on a free body, above a geom that is fixed to the world."""
    assets = []
    geoms = []
    for k, (kind, size, quat) in enumerate(zip(kinds, sizes, quats, strict=True)):
        shape = f'type="{kind}" size="{size[0]} {size[1]} {size[2]}"'
        if kind == "mesh":
            points = np.random.default_rng(k).normal(size=(60, 3)) * size
            numbers = " ".join(map(str, points.ravel()))
            assets.append(f'<mesh name="m{k}" vertex="{numbers}"/>')
            shape = f'type="mesh" mesh="m{k}"'
        geoms.append(f'<geom name="g{k}" {shape} quat="{" ".join(map(str, quat))}"/>')
    text = (
        f"<mujoco><asset>{''.join(assets)}</asset><worldbody>{geoms[0]}"
        f'<body name="b"><freejoint/>{geoms[1]}</body></worldbody></mujoco>'
    )
    return rik.Scene(rik.load_robot(text))


def bounds(scene, q):
    """(lower, upper, overlap) of the only pair."""
    found = np.zeros(3)
    memory = scene.memory(scene.pair_tables(scene.pairs))
    collision.bounds_of_pair(memory.address, np.asarray(q, float), 0, FARTHEST, found)
    return found


sizes = st.tuples(*[st.floats(-2.5, -0.5).map(lambda x: 10.0**x)] * 3)
aligned = st.just((1.0, 0.0, 0.0, 0.0))
turned = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
quats = st.one_of(aligned, turned)
kinds = st.sampled_from(KINDS)


@given(
    st.tuples(kinds, kinds),
    st.tuples(sizes, sizes),
    st.tuples(quats, quats),
    st.tuples(*[st.floats(-0.8, 0.8)] * 3),
    st.sampled_from([None, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7]),
)
def test_bounds_enclose_the_distance_of_mujoco(kinds, sizes, quats, position, gap):
    scene = two_geoms(kinds, sizes, quats)
    q = np.array([*position, 1.0, 0.0, 0.0, 0.0])
    found = scene.clearance(q)
    if gap is not None:
        if found.distance < gap:
            return
        # Moved along the shortest direction until the distance is the requested gap.
        q[:3] += found.normal * (found.distance - gap) * (1 if found.pair[1] == "b" else -1)
        found = scene.clearance(q)
    lower, upper, overlap = bounds(scene, q)
    if found.distance > 1e-6:
        assert lower <= found.distance + 1e-6
        if not overlap:
            assert upper >= found.distance - 1e-6
        if upper - lower < 1e-7:
            assert lower == pytest.approx(found.distance, abs=1e-6)
        if found.distance > 1e-3:
            assert not overlap
            assert lower == pytest.approx(found.distance, abs=1e-6)
    elif found.distance < -1e-6:
        assert lower <= 1e-9


@given(
    st.lists(st.tuples(*[st.floats(-1.0, 1.0)] * 3), min_size=1, max_size=30),
    st.lists(st.floats(0.0, 0.3), min_size=30, max_size=30),
)
def test_a_capsule_contains_its_balls(points, radii):
    points = np.array(points)
    radii = np.array(radii[: len(points)])
    first, last, radius = np.split(capsule_around(points, radii), [3, 6])
    along = last - first
    square = float(along @ along)
    share = (
        np.clip((points - first) @ along / square, 0, 1) if square > 0 else np.zeros(len(points))
    )
    distance = np.linalg.norm(points - first - share[:, None] * along, axis=1)
    assert (distance + radii <= radius + 1e-12).all()


@pytest.mark.parametrize("name", ["puma560", "panda", "ur5e", "humanoid", "lion", "seven_segment"])
def test_containers_contain_surface_points(name):
    """Balls and capsules contain what MuJoCo's support of random directions finds."""
    robot = rik.load_robot(name)
    scene = rik.Scene(robot)
    tables = scene._tables.block.arrays
    rng = np.random.default_rng(1)
    for link in range(len(tables["node"])):
        first = tables["capsule"][link, :3]
        last = tables["capsule"][link, 3:6]
        along = last - first
        for g in range(*tables["geom_start"][link : link + 2]):
            if tables["kind"][g] == mujoco.mjtGeom.mjGEOM_PLANE:
                continue
            points = surface_points(int(tables["kind"][g]), tables["size"][g], rng)
            assert np.linalg.norm(points, axis=1).max() <= tables["ball"][g]
            local = tables["local"][g]
            placed = points @ local[3:].reshape(3, 3).T + local[:3]
            share = np.clip((placed - first) @ along / max(along @ along, 1e-30), 0, 1)
            distance = np.linalg.norm(placed - first - share[:, None] * along, axis=1)
            assert distance.max() <= tables["capsule"][link, 6]


def surface_points(kind, size, rng):
    """Points (n, 3) on the surface of a primitive."""
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return directions * size[0]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return directions * size[0] + np.sign(directions[:, 2:]) * (0, 0, size[1])
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return directions * size
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        rim = directions[:, :2] / np.linalg.norm(directions[:, :2], axis=1)[:, None]
        return np.column_stack([rim * size[0], np.sign(directions[:, 2]) * size[1]])
    return np.sign(directions) * size


@given(st.integers(0, 2**32 - 1))
def test_no_filter_drops_a_pair_that_is_nearer_than_the_reach(seed):
    rng = np.random.default_rng(seed)
    robot = rik.load_robot(rng.choice(["puma560", "panda", "humanoid"]))
    scene = rik.Scene(robot, [rik.Box("a", size=(0.5, 0.02, 0.4), pose=rik.Pose((0.4, 0.1, 0.5)))])
    q = robot.sample(rng)
    reach = float(rng.uniform(0.0, 0.3))
    found = scene.distances(q, reach)
    exact = scene.clearance(q).distance
    assert found <= max(exact, 0.0) + 1e-6
    assert found >= min(max(exact, 0.0), reach) - 1e-6 or exact <= 0.0
