"""Intrinsics against OpenCV's projection, and written to a file and read back."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.errors import CalibrationError

CAMERA = CameraIntrinsics(
    640, 480, 612.0, 605.0, 322.3, 236.8, (-0.28, 0.09, 0.0007, -0.0004, -0.01)
)


def coefficient(size: float) -> st.SearchStrategy[float]:
    return st.floats(-size, size)


def brown(count: int) -> st.SearchStrategy[tuple[float, ...]]:
    sizes = (0.25, 0.08, 2e-3, 2e-3, 0.02, 0.1, 0.03, 0.01)
    return st.tuples(*(coefficient(s) for s in sizes[:count]))


@st.composite
def cameras(draw: st.DrawFn) -> CameraIntrinsics:
    count = draw(st.sampled_from((0, 4, 5, 8)))
    return CameraIntrinsics(
        640,
        480,
        draw(st.floats(500, 1500)),
        draw(st.floats(500, 1500)),
        draw(st.floats(280, 360)),
        draw(st.floats(200, 280)),
        draw(brown(count)),
        "rational_polynomial" if count == 8 else "plumb_bob",
    )


def points_in_view(rng: np.random.Generator, count: int = 50) -> np.ndarray:
    z = rng.uniform(0.2, 3.0, count)
    return np.stack(
        [rng.uniform(-0.4, 0.4, count) * z, rng.uniform(-0.3, 0.3, count) * z, z], axis=1
    )


@given(cameras(), st.integers(0, 1000))
def test_project_equals_opencvs(camera: CameraIntrinsics, seed: int) -> None:
    points = points_in_view(np.random.default_rng(seed))
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion or (0.0,) * 5)
    )
    assert camera.project(points) == pytest.approx(expected.reshape(-1, 2), abs=1e-9)


@given(st.tuples(*[coefficient(0.05)] * 4), st.integers(0, 1000))
def test_equidistant_equals_opencvs_fisheye(k: tuple[float, ...], seed: int) -> None:
    if not hasattr(cv2, "fisheye"):
        pytest.skip("this OpenCV has no fisheye module")
    camera = CameraIntrinsics(640, 480, 400.0, 405.0, 320.0, 240.0, k, "equidistant")
    points = points_in_view(np.random.default_rng(seed))
    expected, _ = cv2.fisheye.projectPoints(
        points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), camera.matrix, np.array(k)
    )
    assert camera.project(points) == pytest.approx(expected.reshape(-1, 2), abs=1e-9)


@given(cameras())
def test_unproject_inverts_project_to_1e_9(camera: CameraIntrinsics) -> None:
    x, y = np.meshgrid(np.linspace(-0.5, 639.5, 14), np.linspace(-0.5, 479.5, 11))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    rays = camera.unproject(pixels)
    seen = np.isfinite(rays[:, 0])
    # If an inverse exists, it is exact. In the middle of the picture it always exists.
    assert camera.project(rays[seen]) == pytest.approx(pixels[seen], abs=1e-6)
    assert np.isfinite(camera.unproject((camera.cx + 60.0, camera.cy - 60.0))).all()
    normalized = rays[seen, :2] * 0.5
    assert camera.undistort(camera.distort(normalized)) == pytest.approx(normalized, abs=1e-9)


def test_a_pixel_beyond_the_fold_has_no_ray() -> None:
    camera = CameraIntrinsics(640, 480, 300.0, 300.0, 319.5, 239.5, (-0.5, 0.0, 0.0, 0.0))
    # r (1 - r^2 / 2) rises up to r = sqrt(2/3), where it is 0.544: no light falls farther out.
    assert camera.radius_limit == pytest.approx(np.sqrt(2 / 3), abs=0.01)
    assert np.isfinite(camera.unproject((319.5 + 0.54 * 300, 239.5))).all()
    assert np.isnan(camera.unproject((319.5 + 0.55 * 300, 239.5))[:2]).all()


def test_points_behind_the_camera_have_no_pixel() -> None:
    pixels = CAMERA.project([(0.0, 0.0, 1.0), (0.1, 0.1, -1.0), (0.1, 0.1, 0.0)])
    assert pixels[0] == pytest.approx((CAMERA.cx, CAMERA.cy))
    assert np.isnan(pixels[1:]).all()


@given(cameras())
def test_pixel_jacobian_is_the_derivative(camera: CameraIntrinsics) -> None:
    normalized = np.array([[0.0, 0.0], [0.2, -0.1], [-0.15, 0.25]])
    step = 1e-6
    slope = np.stack(
        [
            (camera.distort(normalized + d) - camera.distort(normalized - d)) / (2 * step)
            for d in step * np.eye(2)
        ],
        axis=2,
    )
    assert camera.pixel_jacobian(normalized) == pytest.approx(slope, rel=1e-6, abs=1e-4)


def test_equidistant_jacobian_and_inverse() -> None:
    camera = CameraIntrinsics(
        640, 480, 300.0, 305.0, 320.0, 240.0, (0.02, -0.01, 0.003, 0.0), "equidistant"
    )
    normalized = np.array([[0.0, 0.0], [1e-5, 0.0], [0.4, -0.3], [-0.8, 0.7]])
    step = 1e-6
    slope = np.stack(
        [
            (camera.distort(normalized + d) - camera.distort(normalized - d)) / (2 * step)
            for d in step * np.eye(2)
        ],
        axis=2,
    )
    assert camera.pixel_jacobian(normalized) == pytest.approx(slope, rel=1e-5, abs=1e-3)
    assert camera.undistort(camera.distort(normalized)) == pytest.approx(normalized, abs=1e-9)


def test_one_point_and_many_have_the_same_shape_as_asked() -> None:
    assert CAMERA.project((0.1, 0.2, 1.0)).shape == (2,)
    assert CAMERA.unproject((100.0, 100.0)).shape == (3,)
    assert CAMERA.unproject(np.zeros((5, 2))).shape == (5, 3)


def test_scaling_respects_the_half_pixel() -> None:
    small = CAMERA.scaled(320, 240)
    points = points_in_view(np.random.default_rng(0))
    # Position from the image's edge, not from the first pixel's centre, halves.
    assert small.project(points) + 0.5 == pytest.approx(
        (CAMERA.project(points) + 0.5) / 2, abs=1e-9
    )


def test_scaling_to_another_aspect_ratio_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"640x480.*1280x720.*aspect"):
        CAMERA.scaled(1280, 720)


@pytest.mark.parametrize(
    ("size", "hint"), [((1280, 960), r"scaled\(1280, 960\)"), ((1280, 720), "another aspect")]
)
def test_the_error_of_a_wrong_size_gives_advice(size: tuple[int, int], hint: str) -> None:
    with pytest.raises(CalibrationError, match=rf"640x480.*{size[0]}x{size[1]}(.|\n)*{hint}"):
        CAMERA.require_size(*size)
    CAMERA.require_size(640, 480)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"fx": 100.0}, "fx = 100 px is implausible"),
        ({"fy": 4000.0}, "fy = 4000 px is implausible"),
        ({"cx": 700.0}, "principal point"),
    ],
)
def test_implausible_cameras_are_refused(change: dict[str, float], text: str) -> None:
    numbers = {"fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0} | change
    with pytest.raises(CalibrationError, match=text):
        CameraIntrinsics(640, 480, **numbers).require_plausible()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((640, 480, float("nan"), 600.0, 320.0, 240.0), "cannot exist"),
        ((640, 480, -600.0, 600.0, 320.0, 240.0), "cannot exist"),
        ((640, 480, 600.0, 600.0, 320.0, 240.0, (0.1,)), "1 distortion coefficients"),
        ((640, 480, 600.0, 600.0, 320.0, 240.0, (), "magic"), "unknown distortion model 'magic'"),
    ],
)
def test_impossible_cameras_are_refused(arguments: tuple, text: str) -> None:
    with pytest.raises(CalibrationError, match=text):
        CameraIntrinsics(*arguments)


@given(cameras())
def test_a_file_reads_back_bit_equal(
    tmp_path_factory: pytest.TempPathFactory, camera: CameraIntrinsics
) -> None:
    path = tmp_path_factory.mktemp("camera") / "camera.yaml"
    camera.save(path)
    back = CameraIntrinsics.load(path)
    assert back.matrix.tolist() == camera.matrix.tolist()
    padded = camera.distortion or (0.0,) * 5
    assert back.distortion == padded
    assert (back.model, back.size) == (camera.model, camera.size)
