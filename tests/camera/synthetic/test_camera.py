"""The synthetic camera: exact corners, hidden parts, truth, repeatability."""

from dataclasses import replace

import cv2
import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from robot_ik.camera.corners import refine_markers
from robot_ik.camera.detection import MarkerDetector
from robot_ik.camera.drawing.prints import PRINT_MARKER, marker_print, project_print
from robot_ik.camera.drawing.rays import ray_field
from robot_ik.camera.image import marker_bits
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.sources import FrameSource
from robot_ik.camera.synthetic.camera import (
    SyntheticMarker,
    SyntheticScene,
    SyntheticSource,
)
from robot_ik.camera.synthetic.painted import INK, PAPER, SceneTable
from robot_ik.camera.synthetic.sensor import LINEAR
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.ports import VirtualClock
from robot_ik.robot import load_robot

LINEAR_SENSOR = replace(LINEAR, noise=2.0)
LENS = CameraIntrinsics(640, 480, 800.0, 796.0, 322.4, 236.1, (-0.18, 0.06, 0.0006, -0.0004, 0.0))
SMALL = CameraIntrinsics(320, 240, 400.0, 400.0, 159.5, 119.5, (-0.18, 0.06, 0.0006, -0.0004, 0.0))
OVERHEAD = Pose.look_at((0.05, -0.4, 0.6), (0.0, 0.0, 0.0))


def desk(
    *markers: SyntheticMarker,
    body: str = "",
    lens: CameraIntrinsics = LENS,
    camera: Pose = OVERHEAD,
) -> SyntheticScene:
    objects = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    return SyntheticScene(objects, lens, camera, markers, SceneTable(0.0, (-0.5, 0.5), (-0.4, 0.5)))


def photograph(scene: SyntheticScene, **options: object) -> SyntheticSource:
    """Return a source with a linear sensor, which does not shift edges."""
    sensor = LINEAR_SENSOR
    for name in ("noise", "blur"):
        if name in options:
            sensor = replace(sensor, **{name: options.pop(name)})  # type: ignore[arg-type]
    return SyntheticSource(scene, lambda: np.zeros(0), sensor=sensor, **options)  # type: ignore[arg-type]


def corner_errors(scene: SyntheticScene, seeds: int, **options: object) -> np.ndarray:
    """Return refined minus true corners (n, 2) of all markers, in one picture per seed."""
    detector = MarkerDetector("DICT_5X5_50")
    errors = []
    for seed in range(seeds):
        frame = photograph(scene, seed=seed, **options).read()
        assert isinstance(frame.truth, dict)
        found = {d.id: d.corners for d in detector.detect(frame.image)}
        assert set(found) == set(frame.truth["corners"])
        for id, corners in found.items():
            (refined,) = refine_markers(
                frame.image, [corners], [id], "DICT_5X5_50", scene.intrinsics
            )
            errors.append(refined.pixels - frame.truth["corners"][id])
    return np.concatenate(errors)


def marker_grid() -> tuple[SyntheticMarker, ...]:
    rng = np.random.default_rng(11)
    poses = []
    for k in range(9):
        place = np.array([(k % 3 - 1) * 0.13, (k // 3 - 1) * 0.10, 0.04]) + np.array(
            [*rng.uniform(-0.01, 0.01, 2), 0.003 * k]
        )
        tilt = Pose(place, rotation_exp([0, 0, rng.uniform(-3, 3)])).compose(
            Pose(wxyz=rotation_exp([*rng.uniform(-0.4, 0.4, 2), 0]))
        )
        poses.append(tilt)
    return tuple(SyntheticMarker(k, 0.05, pose) for k, pose in enumerate(poses))


def test_corners_without_noise_are_exact_to_hundredths_of_a_pixel() -> None:
    errors = corner_errors(desk(*marker_grid()), 1, noise=0.0)
    assert np.sqrt((errors**2).mean()) <= 0.03
    assert np.abs(errors.mean(axis=0)).max() <= 0.01


def test_corners_with_noise_have_no_bias() -> None:
    errors = corner_errors(desk(*marker_grid()), 3, noise=4.0)
    assert np.sqrt((errors**2).mean()) <= 0.10
    assert np.abs(errors.mean(axis=0)).max() <= 0.03


def test_a_sheet_is_painted_like_an_average_of_very_many_samples() -> None:
    field = ray_field(LENS)
    pose = Pose((0.02, -0.03, 0.8), rotation_exp([2.6, 0.3, 0.4]))
    sheet = marker_print("DICT_5X5_50", 7, 0.05, 0.05 / 7)
    painted = project_print(sheet, pose.compose(PRINT_MARKER), field)
    assert painted is not None
    x0, y0, x1, y1 = painted.box
    grey = (1 - painted.coverage) * 0.5 + painted.coverage * (PAPER + (INK - PAPER) * painted.ink)
    bits = marker_bits("DICT_5X5_50", 7)
    step = (np.arange(12) + 0.5) / 12 - 0.5
    expected = np.zeros(grey.shape)
    normal = pose.rotation[:, 2]
    for dy in step:
        pixels = np.stack(
            np.meshgrid((np.arange(x0, x1)[:, None] + step).ravel(), np.arange(y0, y1) + dy), -1
        )
        rays = LENS.unproject(pixels.reshape(-1, 2))
        point = pose.inverse().apply(rays * ((normal @ pose.position) / (rays @ normal))[:, None])
        u = (point[:, 0] / 0.05 + 0.5) * 7
        v = (0.5 - point[:, 1] / 0.05) * 7
        tone = np.full(len(u), 0.5)
        tone[(np.abs(u - 3.5) < 4.5) & (np.abs(v - 3.5) < 4.5)] = PAPER
        print_ = (np.abs(u - 3.5) < 3.5) & (np.abs(v - 3.5) < 3.5)
        tone[print_] = np.where(bits[v[print_].astype(int), u[print_].astype(int)] > 0, PAPER, INK)
        expected += tone.reshape(y1 - y0, x1 - x0, 12).mean(axis=2) / 12
    away = grey - expected
    # 0.02 of the contrast is an edge displaced by 0.02 px in that pixel.
    assert np.abs(away).max() < 0.03 * (PAPER - INK)
    assert np.sqrt((away**2).mean()) < 0.003
    assert abs(away.mean()) < 2e-4


def test_something_in_front_hides_part_of_a_marker_along_its_exact_outline() -> None:
    # The box covers the left half of the marker, seen from straight above.
    above = Pose.look_at((0.0, 0.0, 0.5), (0.0, 0.0, 0.0), up=(0, 1, 0))
    body = "<geom type='box' size='.05 .1 .02' pos='-.05 0 .1' rgba='0 1 0 1'/>"
    marker = SyntheticMarker(3, 0.06, Pose(), margin=0.01)
    frame = photograph(desk(marker, body=body, camera=above), blur=0.0, noise=0.0).read()
    assert isinstance(frame.truth, dict)
    assert frame.truth["visible"][3] == pytest.approx(0.5, abs=0.002)
    free = photograph(desk(marker, camera=above), blur=0.0, noise=0.0).read()
    x = round(LENS.project(above.inverse().apply([0.0, 0.0, 0.0]))[0])
    y = slice(150, 320)
    assert (frame.image[y, x - 20 : x - 1, 1] > frame.image[y, x - 20 : x - 1, 2] + 40).all(), (
        "green box"
    )
    # To the right of the box only the shadow changes the print.
    ink = free.image[y, x + 2 : x + 30].mean(axis=2) < 60
    assert ink.any() and (frame.image[y, x + 2 : x + 30].mean(axis=2)[ink] < 60).all()


def test_a_marker_behind_the_table_or_turned_away_is_not_seen() -> None:
    under = SyntheticMarker(1, 0.05, Pose((0.1, 0.0, -0.05)))
    turned = SyntheticMarker(2, 0.05, Pose((-0.1, 0.0, 0.01), rotation_exp([np.pi, 0, 0])))
    shown = SyntheticMarker(4, 0.05, Pose())
    frame = photograph(desk(under, turned, shown)).read()
    assert isinstance(frame.truth, dict) and set(frame.truth["pose_camera_marker"]) == {4}
    assert [d.id for d in MarkerDetector("DICT_5X5_50").detect(frame.image)] == [4]


def test_truth_is_correct_and_can_be_removed() -> None:
    pose = Pose((0.03, 0.02, 0.0), rotation_exp([0, 0, 0.7]))
    clock = VirtualClock(5.0)
    source = photograph(desk(SyntheticMarker(9, 0.05, pose)), clock=clock)
    assert isinstance(source, FrameSource)
    with source:
        first = source.read()
        second = source.read()
    assert (first.sequence, second.sequence, first.time) == (0, 1, 5.0)
    truth = first.truth
    assert isinstance(truth, dict)
    assert truth["pose_world_camera"] is OVERHEAD
    assert OVERHEAD.compose(truth["pose_camera_marker"][9]).distance(pose) == pytest.approx(
        (0, 0), abs=1e-9
    )
    half = 0.025
    corners = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    pose_camera_marker = OVERHEAD.inverse().compose(pose)
    expected = cv2.projectPoints(
        corners,
        cv2.Rodrigues(pose_camera_marker.rotation)[0],
        pose_camera_marker.position,
        LENS.matrix,
        np.array(LENS.distortion),
    )
    assert truth["corners"][9] == pytest.approx(expected[0].reshape(4, 2), abs=1e-6)
    assert first.without_truth().truth is None


def test_one_seed_gives_one_picture_and_another_seed_another() -> None:
    scene = desk(SyntheticMarker(9, 0.05), lens=SMALL)
    source, same, other = (photograph(scene, seed=s) for s in (3, 3, 4))
    first = source.read().image
    second = source.read().image
    assert (first == same.read().image).all()
    assert (second == same.read().image).all()
    assert (first != second).any(), "noise differs from picture to picture"
    assert (first != other.read().image).any()
    noise = first.astype(float) - second
    assert noise.std() == pytest.approx(2.0 * np.sqrt(2), rel=0.1)


def test_covered_and_blank_markers_cannot_be_found() -> None:
    scene = desk(
        SyntheticMarker(1, 0.05, Pose((-0.1, 0, 0))),
        SyntheticMarker(2, 0.05),
        SyntheticMarker(3, 0.05, Pose((0.1, 0, 0))),
    )
    frame = photograph(
        scene.with_marker(1, condition="covered").with_marker(2, condition="blank")
    ).read()
    assert isinstance(frame.truth, dict) and set(frame.truth["corners"]) == {3}
    assert [d.id for d in MarkerDetector("DICT_5X5_50").detect(frame.image)] == [3]
    with pytest.raises(CameraError, match="no marker 8"):
        scene.with_marker(8, condition="covered")


def test_carried_markers_go_with_the_true_joint_angles() -> None:
    robot = load_robot("puma560")
    lens = CameraIntrinsics(
        640, 360, 1100.0, 1100.0, 319.5, 179.5, (-0.12, 0.05, 0.0005, -0.0003, 0.0)
    )
    markers = [
        SyntheticMarker(20 + k, 0.07, frame=f"marker_{20 + k}", margin=0.007) for k in range(4)
    ]
    camera = Pose.look_at((-1.2, -0.9, 1.3), (-0.5, -0.1, 1.05))
    where = [robot.home]
    scene = SyntheticScene(
        robot,
        lens,
        camera,
        (SyntheticMarker(7, 0.1, Pose((-0.42, -0.1, 0.6))), *markers),
        SceneTable(0.6, (-0.77, -0.23), (-0.5, 0.4)),
    )
    source = SyntheticSource(scene, lambda: where[0], sensor=LINEAR_SENSOR)
    detector = MarkerDetector("DICT_5X5_50")
    for turn in (0.0, 0.15):
        where[0] = robot.home + np.array([turn, 0, 0, 0, 0, turn])
        frame = source.read()
        assert isinstance(frame.truth, dict)
        assert frame.truth["q"] == pytest.approx(where[0])
        visible_ids = [id for id in frame.truth["corners"] if id >= 20]
        assert 1 <= len(visible_ids) <= 2, "of a cube's four sides at most two face a camera"
        found = {d.id: d.corners for d in detector.detect(frame.image)}
        for id in visible_ids:
            side = robot.forward(where[0], f"marker_{id}")
            assert frame.truth["pose_world_marker"][id].distance(side) == pytest.approx(
                (0, 0), abs=1e-9
            )
            (refined,) = refine_markers(frame.image, [found[id]], [id], "DICT_5X5_50", lens)
            assert np.abs(refined.pixels - frame.truth["corners"][id]).max() < 0.5


def test_corners_beside_an_object_with_its_shadow_are_exact() -> None:
    scene = desk(*marker_grid(), body="<geom type='sphere' size='.05' pos='.2 .15 .05'/>")
    errors = corner_errors(scene, 1, noise=0.0)
    assert np.sqrt((errors**2).mean()) <= 0.03


def test_a_moving_marker_is_at_its_position_of_that_time() -> None:
    clock = VirtualClock()
    scene = desk(SyntheticMarker(2, 0.05, lambda now: Pose((0.1 * now, 0, 0))), lens=SMALL)
    source = photograph(scene, clock=clock)
    for now in (0.0, 0.5):
        clock.sleep_until(now)
        truth = source.read().truth
        assert isinstance(truth, dict)
        assert truth["pose_world_marker"][2].position == pytest.approx([0.1 * now, 0, 0])


@settings(max_examples=12)
@given(st.tuples(*[st.floats(-0.12, 0.12)] * 3), st.tuples(*[st.floats(-3, 3)] * 3))
@example((0.0, 0.0, 0.0), (0.0, 3.0, 2.0))
def test_a_camera_at_any_pose_takes_a_picture(
    place: tuple[float, float, float], turn: tuple[float, float, float]
) -> None:
    body = (
        "<geom type='sphere' size='.04' pos='0 0 .05'/>"
        "<geom type='box' size='.03 .03 .1' pos='.1 0 .1'/>"
    )
    camera = Pose((place[0], place[1], place[2] + 0.05), rotation_exp(turn))
    tiny = CameraIntrinsics(64, 48, 40.0, 40.0, 31.5, 23.5, (-0.2, 0.05, 0, 0, 0))
    frame = photograph(
        desk(
            SyntheticMarker(1, 0.05),
            SyntheticMarker(2, 0.05, Pose((0, 0, 0.09))),
            body=body,
            lens=tiny,
            camera=camera,
        )
    ).read()
    assert frame.image.shape == (48, 64, 3)


def test_impossible_scenes_are_rejected() -> None:
    with pytest.raises(CameraError, match="twice"):
        desk(SyntheticMarker(1, 0.05), SyntheticMarker(1, 0.07))
    with pytest.raises(CameraError, match="50 is not in DICT_5X5_50"):
        photograph(desk(SyntheticMarker(50, 0.05), lens=SMALL)).read()
    with pytest.raises(CameraError, match="did you mean 'DICT_5X5_50'"):
        photograph(desk(SyntheticMarker(1, 0.05, dictionary="DICT_5X550"), lens=SMALL)).read()


@pytest.mark.parametrize(
    "lens",
    [
        LENS,
        CameraIntrinsics(
            640, 480, 400, 400, 319.5, 239.5, (0.05, -0.01, 0.002, 0.001), "equidistant"
        ),
    ],
)
def test_interpolated_rays_are_those_of_the_lens(lens: CameraIntrinsics) -> None:
    field = ray_field(lens)
    pixels = np.random.default_rng(1).uniform((-0.5, -0.5), (639.5, 479.5), (500, 2))
    assert np.abs(field.points(pixels) - lens.undistort(pixels)).max() * lens.fx < 5e-3
    centres = np.stack(np.meshgrid(np.arange(10.0, 13.0), np.arange(20.0, 22.0)), -1)
    block = field.points(centres.reshape(-1, 2)).reshape(centres.shape)
    assert field.box(10, 20, 13, 22) == pytest.approx(block, abs=1e-12)
