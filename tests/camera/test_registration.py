"""The robot on a board: real things before it, overlay against truth, remedies for delay."""

from collections.abc import Callable

import cv2
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.camera import drawing_errors
from benchmarks.camera.drawing_errors import DISTORTED
from robot_ik.camera.drawing.drawn_robot import DrawnRobot
from robot_ik.camera.drawing.occluders import BoxTable, load_occluders, occluder_boxes
from robot_ik.camera.drawing.painter import Layer
from robot_ik.camera.registration import BoardTracker, Registrar, optical_motion
from robot_ik.camera.sources import Frame
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.camera.targets import marker_grid
from robot_ik.errors import ConfigError
from robot_ik.geometry import Pose
from robot_ik.robot import load_robot

BOARD = marker_grid(2, 2, 0.05, 0.012, dictionary="DICT_4X4_50")
EYE = Pose.look_at((0.10, -0.80, 0.62), (0.0, 0.06, 0.15))


def standing(scale: float = 0.3, **more: object) -> tuple[DrawnRobot, np.ndarray]:
    robot = load_robot("puma560")
    return DrawnRobot(robot.model, Pose(), scale, **more), robot.qpos(robot.home)  # type: ignore[arg-type]


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def test_real_objects_in_front_of_the_robot_hide_it() -> None:
    box = BoxTable(position=(0.02, -0.12, 0.06), size=(0.10, 0.04, 0.12), yaw_deg=15.0)
    masks = []
    for occluders in (None, occluder_boxes([box])):
        drawn, qpos = standing(occluders=occluders)
        masks.append(drawn.draw(qpos, DISTORTED, EYE).robot.mask(640, 480) > 127)
    hidden = masks[0] & ~masks[1]
    corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T * box.size
    turn = np.deg2rad(15.0)
    corners[:, :2] = corners[:, :2] @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    pixels = DISTORTED.project(EYE.inverse().apply(corners + box.position))
    outline = np.zeros((480, 640), np.uint8)
    cv2.fillConvexPoly(outline, cv2.convexHull(np.rint(pixels).astype(np.int32)), 1)
    assert hidden.sum() > 1500
    assert not (hidden & (cv2.dilate(outline, np.ones((3, 3), np.uint8)) == 0)).any()
    assert not (masks[1] & (cv2.erode(outline, np.ones((5, 5), np.uint8)) > 0)).any()


def test_a_robot_of_another_size_is_the_same_picture_from_elsewhere() -> None:
    drawn, qpos = standing(0.25, shadow=False)
    small = drawn.draw(qpos, DISTORTED, EYE).robot
    large = standing(1.0, shadow=False)[0].draw(qpos, DISTORTED, Pose(EYE.position * 4, EYE.wxyz))
    assert small.box == large.robot.box
    assert np.abs(small.coverage.astype(int) - large.robot.coverage).max() <= 1


def test_the_shadow_of_a_robot_larger_than_the_picture_is_no_softer_than_the_picture(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    softness: list[float] = []

    def blur(image: np.ndarray, size: tuple[int, int], sigma: float) -> np.ndarray:
        softness.append(sigma)
        return image

    monkeypatch.setattr(cv2, "GaussianBlur", blur)
    # as high as the lens: points of it are millions of pixels away
    drawn, qpos = standing(1.0)
    for height in (0.3, 0.6, 0.9):
        drawn.draw(qpos, DISTORTED, Pose.look_at((0.05, -0.45, height), (0.0, 0.0, 0.1)))
    assert len(softness) == 3
    assert max(softness) <= 3.0


def test_spheres_are_where_opencv_projects_them() -> None:
    errors = drawing_errors.projection_errors(DISTORTED)
    assert errors.count > 100
    assert errors.rms <= 0.08
    assert errors.worst <= 0.20
    assert errors.bias <= 0.02


def test_a_robot_on_a_board_is_registered_to_a_third_of_a_pixel() -> None:
    errors = drawing_errors.overlay_errors(0.8, 6)
    assert errors.count > 400
    assert errors.rms <= 0.3
    assert errors.worst <= 1.0


def test_each_remedy_reduces_the_error_of_a_delay() -> None:
    found = drawing_errors.latency_errors(0.066, 1.1)
    assert found["delayed video"].rms < 0.3
    assert found["nothing"].rms > 5.0
    assert found["less delay (half)"].rms < 0.6 * found["nothing"].rms
    assert found["image shifting"].rms < 0.7 * found["nothing"].rms
    assert found["prediction"].rms < 0.4 * found["nothing"].rms
    assert found["prediction and shifting"].rms < found["prediction"].rms


@settings(max_examples=50)
@given(
    st.floats(-3, 3),
    st.floats(0.6, 1.6),
    st.floats(-50, 50),
    st.floats(-50, 50),
    st.integers(0, 2**32 - 1),
)
def test_optical_motion_finds_shift_turn_and_zoom(
    angle: float, zoom: float, dx: float, dy: float, seed: int
) -> None:
    points = np.random.default_rng(seed).uniform(0, 400, (6, 2))
    c = zoom * np.cos(angle)
    s = zoom * np.sin(angle)
    motion = np.array([[c, -s, dx], [s, c, dy]])
    moved = points @ motion[:, :2].T + motion[:, 2]
    before = {(0, k): p for k, p in enumerate(points)}
    after = {(0, k): p for k, p in enumerate(moved[:5])}
    np.testing.assert_allclose(optical_motion(before, after), motion, atol=1e-8)
    assert np.allclose(optical_motion(before, {}), np.eye(2, 3))


@given(st.integers(-60, 60), st.integers(-60, 60))
@settings(max_examples=20)
def test_a_layer_moved_by_whole_pixels_keeps_its_pixels(dx: int, dy: int) -> None:
    rng = np.random.default_rng(1)
    layer = Layer(
        (30, 20, 70, 50),
        rng.integers(0, 255, (30, 40, 3), np.uint8),
        np.full((30, 40), 255, np.uint8),
    )
    moved = layer.shifted(np.array([[1.0, 0.0, dx], [0.0, 1.0, dy]]), 100, 80)
    whole = np.zeros((80 + 200, 100 + 200, 3), np.uint8)
    whole[120 + dy : 150 + dy, 130 + dx : 170 + dx] = layer.colour
    image = np.zeros((80, 100, 3), np.uint8)
    moved.over(image)
    assert (image == whole[100:180, 100:200]).all()


def test_a_lost_board_is_drawn_on_for_a_quarter_second(
    model_of: Callable[..., mujoco.MjModel],
) -> None:
    pose = Pose((0.0, 0.0, 0.7), (0.0, 1.0, 0.0, 0.0))
    markers = {id: (side, pose.compose(place)) for id, (side, place) in BOARD.markers.items()}
    image = render_markers(STANDARD_CAMERA, markers, np.random.default_rng(0), margin=0.12)
    colour = np.repeat(image[:, :, None], 3, axis=2)
    drawn = DrawnRobot(model_of("<geom type='box' size='.02 .02 .02' pos='0 0 .02'/>"))
    registrar = Registrar(BoardTracker(BOARD, STANDARD_CAMERA), drawn, STANDARD_CAMERA)
    empty = np.zeros_like(colour)
    drawn = {}
    for time, picture in ((0.0, colour), (0.1, empty), (0.2, empty), (0.4, empty)):
        frame = Frame(picture, time, 0)
        shown, _ = registrar.compose(registrar.track(frame), frame, [])
        drawn[time] = bool((shown != picture).any())
        assert (picture == (colour if time == 0.0 else empty)).all(), (
            "the frame itself must not change"
        )
    assert drawn == {0.0: True, 0.1: True, 0.2: True, 0.4: False}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "box: this key is missing; allowed: \\[\\[box\\]\\] with position"),
        ("[[box]]\nposition = [0, 0, 0]", r"box\[0\].size: this key is missing"),
        (
            "[[box]]\nposition = [0, 0, 0]\nsize = [1, 1, 0]",
            r"box\[0\].size\[2\]: 0 is not right; allowed: greater than 0",
        ),
        ("[[box]]\nposition = [0, 0, nan]\nsize = [1, 1, 1]", r"position\[2\]: nan is not right"),
        (
            "[[box]]\nposition = [0, 0]\nsize = [1, 1, 1]",
            r"box\[0\].position: \[0, 0\] is not right; allowed: 3 numbers",
        ),
        ("x = ", "not valid TOML"),
    ],
)
def test_an_invalid_file_of_occluders_is_rejected(
    text: str, said: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    file = tmp_path_factory.mktemp("occluders") / "things.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=said):
        load_occluders(file)


def test_occluders_are_boxes_or_a_model(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("occluders")
    (folder / "t.toml").write_text(
        "[[box]]\nposition = [0.1, 0, 0.05]\nsize = [0.1, 0.2, 0.1]\nyaw_deg = 90"
    )
    model = load_occluders(folder / "t.toml")
    np.testing.assert_allclose(model.geom_size[0], [0.05, 0.1, 0.05])
    np.testing.assert_allclose(
        np.abs(model.geom_quat[0]), [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-9
    )
    (folder / "t.xml").write_text("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")
    assert load_occluders(folder / "t.xml").ngeom == 1
    (folder / "bad.xml").write_text("<mujoco><worldbody><geom/></worldbody></mujoco")
    for name in ("bad.xml", "none.toml"):
        with pytest.raises(ConfigError):
            load_occluders(folder / name)
