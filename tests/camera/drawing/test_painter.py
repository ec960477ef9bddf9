"""The painter against OpenCV's projection and MuJoCo's rays."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import cv2
import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from robot_ik.camera.drawing import overlay
from robot_ik.camera.drawing.faces import Faces, bounding_box, faces_in_picture
from robot_ik.camera.drawing.meshes import ROUND_PX, cached_mesh, triangulate
from robot_ik.camera.drawing.painter import SurfaceBuffer, geom_paint, paint_mask
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.robot import load_robot

LENS = CameraIntrinsics(640, 480, 612.0, 605.0, 331.3, 228.9, (-0.28, 0.09, 0.001, -0.0007, 0.0))
PINHOLE = CameraIntrinsics(640, 480, 612.0, 605.0, 331.3, 228.9)
WIDE = CameraIntrinsics(
    1280, 720, 1100.0, 1100.0, 639.5, 359.5, (-0.12, 0.05, 0.0005, -0.0003, 0.0)
)
VIEW = Pose.look_at((-1.55, -1.25, 1.45), (-0.22, -0.08, 0.78))

SHAPES = {
    "sphere": ("size='.11'", 4 / 3 * np.pi * 0.11**3),
    "capsule": ("size='.06 .12'", np.pi * 0.06**2 * 0.24 + 4 / 3 * np.pi * 0.06**3),
    "cylinder": ("size='.08 .13'", np.pi * 0.08**2 * 0.26),
    "ellipsoid": ("size='.06 .10 .14'", 4 / 3 * np.pi * 0.06 * 0.10 * 0.14),
    "box": ("size='.06 .10 .16'", 8 * 0.06 * 0.10 * 0.16),
}


@cache
def _rays_through(lens: CameraIntrinsics) -> np.ndarray:
    """Return the directions (h w, 3) of the rays of all pixels, camera frame."""
    pixels = (
        np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), -1)
        .reshape(-1, 1, 2)
        .astype(float)
    )
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
    coefficients = np.array(lens.distortion) if lens.distortion else None
    normalized = (
        cv2.undistortPointsIter(pixels, lens.matrix, coefficients, None, None, stop)
        if hasattr(cv2, "undistortPointsIter")
        else cv2.undistortPoints(pixels, lens.matrix, coefficients, criteria=stop)
    )
    return np.concatenate([normalized.reshape(-1, 2), np.ones((len(pixels), 1))], axis=1)


def seen_by_rays(
    model: mujoco.MjModel, qpos: np.ndarray, lens: CameraIntrinsics, camera: Pose
) -> np.ndarray:
    """Return the geom of each pixel (h, w) by OpenCV's lens and MuJoCo's rays. -1: none."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    rays = _rays_through(lens) @ camera.rotation.T
    geom = np.full(len(rays), -1, np.int32)
    depth = np.zeros(len(rays))
    groups = np.array([1, 1, 1, 0, 0, 0], np.uint8)
    mujoco.mj_multiRay(
        model,
        data,
        camera.position,
        rays.ravel(),
        groups,
        True,
        -1,
        geom,
        depth,
        None,
        len(rays),
        1e10,
    )
    return geom.reshape(lens.height, lens.width)


def painted_geoms(
    model: mujoco.MjModel, qpos: ArrayLike, lens: CameraIntrinsics, camera: Pose
) -> np.ndarray:
    """Return the geom of each pixel (h, w) by the painter. -1: none."""
    faces = faces_in_picture(model, qpos, lens, camera)
    faces.lit[:] = (1.0, 0.0)
    paint = geom_paint(model)
    paint[:, 0] = np.arange(model.ngeom)
    buffer = SurfaceBuffer((0, 0, *lens.size), 1)
    buffer.fill(faces, paint)
    return np.where(buffer.depth > 0.0, buffer.colour[..., 0].astype(int), -1)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def farthest(a: np.ndarray, b: np.ndarray) -> float:
    """Return the largest distance of a pixel of one mask from the other mask, px."""
    gap = 0.0
    for one, other in ((a, b), (b, a)):
        away = cv2.distanceTransform((~other).astype(np.uint8), cv2.DIST_L2, 5)
        gap = max(gap, float(away[one].max(initial=0.0)))
    return gap


def visible_corners(faces: Faces) -> np.ndarray:
    """Return the pixels of the corners of faces that face the camera."""
    corners = faces.pixels[faces.faces]
    across = corners[:, 2] - corners[:, 0]
    along = corners[:, 3] - corners[:, 1]
    return corners[across[:, 0] * along[:, 1] < across[:, 1] * along[:, 0]].reshape(-1, 2)


def centroid_of_sphere(centre: np.ndarray, radius: float, lens: CameraIntrinsics) -> np.ndarray:
    """Return the centroid of the outline of a sphere, px, projected by OpenCV."""
    distance = np.linalg.norm(centre)
    axis = centre / distance
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)[:, None]
    ring = (
        radius
        * np.sqrt(1 - (radius / distance) ** 2)
        * (np.cos(angle) * side + np.sin(angle) * np.cross(axis, side))
    )
    touching = centre * (1 - (radius / distance) ** 2) + ring
    coefficients = np.array(lens.distortion) if lens.distortion else None
    pixels = cv2.projectPoints(touching, np.zeros(3), np.zeros(3), lens.matrix, coefficients)[
        0
    ].reshape(-1, 2)
    moments = cv2.moments((pixels - pixels[0]).astype(np.float32).reshape(-1, 1, 2))
    return pixels[0] + [moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]]


@pytest.mark.parametrize("kind", SHAPES)
def test_a_primitive_is_closed_faces_outwards_and_has_its_volume(
    kind: str, model_of: Callable[..., mujoco.MjModel]
) -> None:
    size, volume = SHAPES[kind]
    mesh = triangulate(model_of(f"<geom type='{kind}' {size}/>"), 0)
    assert mesh is not None
    total = 0.0
    for corners in ((0, 1, 2), (0, 2, 3)):
        a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in corners)
        total += float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6
    assert total == pytest.approx(volume, rel=0.02)
    model = cached_mesh(model_of(f"<geom type='{kind}' {size}/>"))
    assert (model.edge_faces[:, 0] != model.edge_faces[:, 1]).all(), "an open edge"
    assert (np.einsum("ij,ij->i", mesh.normals, mesh.vertices[mesh.faces].mean(axis=1)) > 0).all()


@pytest.mark.parametrize("kind", SHAPES)
@settings(max_examples=4)
@example(turn=(0.0, 0.0, 0.0), x=0.1875, y=0.0625, z=0.75)
@given(
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    x=st.floats(-0.25, 0.25),
    y=st.floats(-0.18, 0.18),
    z=st.floats(0.7, 1.5),
)
def test_a_painted_primitive_covers_the_pixels_that_rays_hit(
    model_of: Callable[..., mujoco.MjModel],
    kind: str,
    turn: tuple[float, float, float],
    x: float,
    y: float,
    z: float,
) -> None:
    quat = " ".join(f"{v:.9f}" for v in rotation_exp(turn))
    model = model_of(f"<geom type='{kind}' {SHAPES[kind][0]} pos='{x} {y} {z}' quat='{quat}'/>")
    rays = seen_by_rays(model, np.zeros(0), LENS, Pose()) >= 0
    mask = paint_mask((480, 640), faces_in_picture(model, [], LENS, Pose())) > 127
    assert overlap(rays, mask) > 0.98
    assert farthest(rays, mask) <= 1.5


@pytest.mark.parametrize("kind", [k for k in SHAPES if k != "box"])
@settings(max_examples=3)
@given(turn=st.tuples(*[st.floats(-3, 3)] * 3), x=st.floats(-0.1, 0.1), z=st.floats(0.5, 2.0))
def test_the_outline_of_a_round_object_is_accurate_to_a_part_of_a_pixel(
    model_of: Callable[..., mujoco.MjModel],
    kind: str,
    turn: tuple[float, float, float],
    x: float,
    z: float,
) -> None:
    # Picture and drawing are compared at this magnification.
    fine = 8
    lens = CameraIntrinsics(100, 80, 110.0, 110.0, 49.5, 39.5)
    large = CameraIntrinsics(800, 640, 880.0, 880.0, 399.5, 319.5)
    quat = " ".join(f"{v:.9f}" for v in rotation_exp(turn))
    model = model_of(f"<geom type='{kind}' {SHAPES[kind][0]} pos='{x} 0 {z}' quat='{quat}'/>")
    faces = faces_in_picture(model, [], lens, Pose())
    mask = (
        paint_mask((640, 800), replace(faces, pixels=(faces.pixels + 0.5) * fine - 0.5), samples=1)
        > 127
    )
    rays = seen_by_rays(model, np.zeros(0), large, Pose()) >= 0
    assert farthest(rays, mask) <= ROUND_PX * fine + 1.0


@pytest.mark.parametrize("count", [1, 3, 4])
def test_any_number_of_samples_covers_the_same(
    model_of: Callable[..., mujoco.MjModel], count: int
) -> None:
    model = model_of("<geom type='box' size='.1 .2 .15' pos='.05 -.02 1.2' euler='20 30 40'/>")
    faces = faces_in_picture(model, [], LENS, Pose())
    usual, other = (paint_mask((251, 301), faces, (200, 101), n).astype(int) for n in (2, count))
    assert usual.sum() > 0.1 * 255 * usual.size
    assert other.sum() == pytest.approx(usual.sum(), rel=2e-3)
    inside = cv2.erode((usual > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert (other[inside] == 255).all(), "a crack between faces"


@pytest.mark.parametrize(
    "sizes", [(".25 .2 .001", ".09 .07 .001"), (".09 .07 .001", ".25 .2 .001")]
)
def test_of_coincident_surfaces_the_first_is_visible(
    model_of: Callable[..., mujoco.MjModel], sizes: tuple[str, str]
) -> None:
    boxes = [
        f"<geom type='box' size='{size}' pos='.1 .1 .9' euler='40 30 0' rgba='{rgba}'/>"
        for size, rgba in zip(sizes, ("1 0 0 1", "0 0 1 1"), strict=True)
    ]
    painted = []
    for geoms in (boxes[:1], boxes[1:], boxes):
        painted.append(painted_geoms(model_of("".join(geoms)), [], PINHOLE, Pose()))
    both = cv2.erode(((painted[0] >= 0) & (painted[1] >= 0)).astype(np.uint8), np.ones((7, 7)))
    assert both.sum() > 2000
    assert (painted[2][both > 0] == 0).all()


def test_a_mesh_geom_is_painted_and_a_fine_one_is_thinned(
    model_of: Callable[..., mujoco.MjModel],
) -> None:
    rng = np.random.default_rng(5)
    points = rng.normal(size=(3000, 3))
    points *= 0.1 / np.linalg.norm(points, axis=1, keepdims=True)
    vertices = " ".join(f"{v:.6f}" for v in points.ravel())
    model = model_of(
        "<geom type='mesh' mesh='ball' pos='0 0 1'/>", f"<mesh name='ball' vertex='{vertices}'/>"
    )
    assert int(model.mesh_facenum[0]) > 3000
    assert len(cached_mesh(model).faces) < 1600
    mask = paint_mask((480, 640), faces_in_picture(model, [], LENS, Pose())) > 127
    assert overlap(seen_by_rays(model, np.zeros(0), LENS, Pose()) >= 0, mask) > 0.96


def test_the_arm_is_painted_where_rays_see_it_and_nearer_parts_hide_farther_ones() -> None:
    robot = load_robot("puma560")
    for q in (
        robot.home,
        robot.home + np.array([-0.12, 0.05, 0.47, 0.3, 0.2, -1.0]),
        robot.home * 0.3,
    ):
        faces = faces_in_picture(robot.model, robot.qpos(q), WIDE, VIEW)
        geom = seen_by_rays(robot.model, robot.qpos(q), WIDE, VIEW)
        mask = paint_mask((720, 1280), faces) > 127
        assert overlap(geom >= 0, mask) > 0.985
        assert farthest(geom >= 0, mask) <= 1.5
        both = cv2.erode(((geom >= 0) & mask).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        assert (
            painted_geoms(robot.model, robot.qpos(q), WIDE, VIEW)[both] == geom[both]
        ).mean() > 0.985


@pytest.mark.parametrize(("lens", "rms", "worst"), [(PINHOLE, 0.05, 0.15), (LENS, 0.08, 0.20)])
def test_projection_identity_of_spheres(
    lens: CameraIntrinsics, rms: float, worst: float, model_of: Callable[..., mujoco.MjModel]
) -> None:
    rng = np.random.default_rng(3)
    misses = []
    for _ in range(80):
        pixel = rng.uniform((30, 30), (610, 450))
        z = rng.uniform(0.4, 2.0)
        centre = lens.unproject(pixel[None])[0] * z
        radius = 8 * z / 610
        model = model_of(
            f"<geom type='sphere' size='{radius}' pos='{centre[0]} {centre[1]} {centre[2]}'/>"
        )
        mask = paint_mask((480, 640), faces_in_picture(model, [], lens, Pose())).astype(float)
        middle = (
            np.array([(mask.sum(0) * np.arange(640)).sum(), (mask.sum(1) * np.arange(480)).sum()])
            / mask.sum()
        )
        misses.append(middle - centroid_of_sphere(centre, radius, lens))
    away = np.linalg.norm(misses, axis=1)
    assert np.sqrt((away**2).mean()) <= rms
    assert away.max() <= worst
    assert np.abs(np.mean(misses, axis=0)).max() <= 0.02


def test_corners_of_faces_are_where_opencv_projects_them(
    model_of: Callable[..., mujoco.MjModel],
) -> None:
    model = model_of("<geom type='box' size='.1 .2 .15' pos='.05 -.02 1.2' euler='20 30 40'/>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * (0.1, 0.2, 0.15)
    world = corners @ data.geom_xmat[0].reshape(3, 3).T + data.geom_xpos[0]
    pixels = cv2.projectPoints(
        world, np.zeros(3), np.zeros(3), LENS.matrix, np.array(LENS.distortion)
    )[0].reshape(-1, 2)
    drawn = visible_corners(faces_in_picture(model, [], LENS, Pose()))
    near = np.linalg.norm(pixels[:, None] - drawn[None], axis=2).min(axis=1)
    assert (near < 0.005).sum() == 7, "three faces of a box show seven corners"


@pytest.mark.parametrize("style", ["solid", "outline", "registered"])
def test_a_geom_through_the_lens_is_cut_and_not_folded(
    style: overlay.Style, model_of: Callable[..., mujoco.MjModel]
) -> None:
    picture = np.zeros((480, 640, 3), np.uint8)
    model = model_of(
        "<geom type='box' size='.05 .05 3' pos='.15 0 0'/>"
        "<geom type='sphere' size='.3' pos='-.5 0 .1'/>"
    )
    drawn = overlay.draw_robot(picture, model, [], LENS, Pose(), style=style, alpha=1.0)
    rays = seen_by_rays(model, np.zeros(0), LENS, Pose()) >= 0
    assert rays.any()
    outside = ~cv2.dilate(rays.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    assert drawn[outside].max() == 0
    if style == "solid":
        assert overlap(drawn.max(axis=2) > 0, rays) > 0.97


def test_floors_and_invisible_geoms_are_left_out(model_of: Callable[..., mujoco.MjModel]) -> None:
    model = model_of(
        "<geom type='plane' size='0 0 .1' pos='0 0 2' euler='180 0 0'/>"
        "<geom type='sphere' size='.1' pos='0 0 1' group='3'/>"
        "<geom type='sphere' size='.1' pos='0 0 1' rgba='1 1 1 0'/>"
    )
    assert bounding_box(faces_in_picture(model, [], LENS, Pose()), 640, 480) == (0, 0, 0, 0)
    assert len(faces_in_picture(model, [], LENS, Pose(), planes=True).chosen) > 0
