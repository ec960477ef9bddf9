"""Live augmented reality: delay and its remedies, the ball in the picture, cameras, the channel."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from robot_ik.camera.sources import Frame
from robot_ik.camera.synthetic.board_table import BOARD, FOLLOWED, synthetic_scene
from robot_ik.camera.target_files import parse_target
from robot_ik.camera.targets import MarkerTarget, marker, marker_points
from robot_ik.geometry import Pose
from robot_ik.robot import load_robot
from robot_ik.testbed.ar.camera import ArCamera
from robot_ik.testbed.ar.late_registrar import LateRegistrar, RecentBoards
from robot_ik.testbed.ar.live import ArPicture, LiveAr
from robot_ik.testbed.ar.scene import ArScene
from robot_ik.testbed.ar.setup import ArDelay, ArSetup
from robot_ik.testbed.ar.warm import is_warm
from robot_ik.testbed.commands import MoveGoal, SetFigure, SetRobot, Start
from robot_ik.testbed.frontends.picture_message import HEADER
from robot_ik.testbed.presets import PRESETS, preset
from robot_ik.testbed.session import Session
from tests.testbed.channel_client import ChannelClient
from tests.waiting import wait_for

RATE_HZ = 30.0
DELAY = 0.15


def board() -> MarkerTarget:
    """Return the board of the synthetic table."""
    target = parse_target(BOARD)
    assert isinstance(target, MarkerTarget)
    return target


@pytest.fixture(scope="module")
def scene() -> ArScene:
    return ArScene(load_robot("tabletop_puma"))


@pytest.fixture(scope="module")
def film() -> tuple[list[Frame], Any]:
    """Forty pictures of a board that moves, with their truth, and their optics."""
    source, clock = synthetic_scene(640, 480, follow=True)
    frames = []
    for number in range(1, 41):
        frames.append(source.read())
        clock.sleep_until(number / RATE_HZ)
    return frames, source.scene.intrinsics


def projected(lens: Any, pose_camera_x: Pose, points: Any) -> Any:
    """Return the pixels (n, 2) of points (n, 3), by OpenCV."""
    vector, _ = cv2.Rodrigues(pose_camera_x.rotation)
    offset = np.array(pose_camera_x.position)
    pixels, _ = cv2.projectPoints(points, vector, offset, lens.matrix, np.array(lens.distortion))
    return pixels.reshape(-1, 2)


def errors_of(film: tuple[list[Frame], Any], scene: ArScene, delay: ArDelay) -> tuple[Any, Any]:
    """Return delays (s) and errors (px) of the drawing, the last twenty pictures.

    The error is judged by the true corners of the board in the picture that is shown.
    """
    frames, lens = film
    truths = {frame.sequence: frame.truth for frame in frames}
    target = board()
    registrar = LateRegistrar(RecentBoards(target, lens), scene.drawn, lens, delay)
    delays = []
    errors = []
    for frame in frames:
        plain = frame.without_truth()
        registrar.take(plain)
        done = registrar.composed(plain, scene.qpos(scene.robot.home, np.zeros(3)))
        if done.pose_camera_board is None:
            continue
        truth: Any = truths[done.shown.sequence]
        wanted = []
        drawn = []
        for id, (side, pose) in target.markers.items():
            points = pose.apply(marker_points(side))
            stand = target.pose_target_stand.inverse().apply(points)
            drawn.append(projected(lens, done.pose_camera_board, stand))
            wanted.append(truth["corners"][id])
        offsets = np.linalg.norm(np.concatenate(drawn) - np.concatenate(wanted), axis=1)
        delays.append(done.delay)
        errors.append((math.sqrt(float(np.mean(offsets**2))), done.error))
    return np.array(delays[-20:]), np.array(errors[-20:])


def test_delayed_video_shows_the_drawing_where_the_board_is(film: Any, scene: ArScene) -> None:
    delays, errors = errors_of(film, scene, ArDelay(DELAY))
    assert (delays == 0.0).all()
    assert errors[:, 0].max() < 0.3


def test_the_newest_picture_shows_the_drawing_late(film: Any, scene: ArScene) -> None:
    delays, errors = errors_of(film, scene, ArDelay(DELAY, "latest"))
    assert (delays >= DELAY - 1e-9).all() and (delays < DELAY + 2.0 / RATE_HZ).all()
    assert errors[:, 0].mean() > 1.5
    assert np.allclose(errors[:, 0], errors[:, 1], atol=0.3), "the error that people see is wrong"


def test_prediction_and_shift_reduce_the_error(film: Any, scene: ArScene) -> None:
    plain = errors_of(film, scene, ArDelay(DELAY, "latest"))[1][:, 1].mean()
    predicted = errors_of(film, scene, ArDelay(DELAY, "latest", predict=True))[1][:, 1].mean()
    shifted = errors_of(film, scene, ArDelay(DELAY, "latest", shift=True))[1][:, 1].mean()
    assert predicted < 0.6 * plain
    assert shifted < 0.5 * plain


def test_less_delay_reduces_the_error(film: Any, scene: ArScene) -> None:
    long = errors_of(film, scene, ArDelay(DELAY, "latest"))[1][:, 0].mean()
    short = errors_of(film, scene, ArDelay(0.0, "latest"))[1][:, 0].mean()
    assert short < 0.5 * long


def test_a_marker_beside_the_board_gives_the_place_of_the_ball(film: Any, scene: ArScene) -> None:
    frames, lens = film
    tracker = RecentBoards(board(), lens, marker(*FOLLOWED, board().dictionary))
    registrar = LateRegistrar(tracker, scene.drawn, lens, ArDelay())
    for frame in frames[:8]:
        plain = frame.without_truth()
        registrar.take(plain)
        done = registrar.composed(plain, scene.qpos(scene.robot.home, np.zeros(3)))
        truth: Any = frame.truth
        in_camera = truth["pose_camera_marker"][FOLLOWED[0]]
        assert done.pose_board_marker is not None and done.pose_camera_board is not None
        position = scene.world_point(np.array(done.pose_board_marker.position))
        in_world = scene.drawn.camera(done.pose_camera_board.inverse()).apply(
            np.array(in_camera.position) / scene.drawn.scale
        )
        assert np.linalg.norm(position - in_world) * scene.drawn.scale < 2e-3


def test_the_ball_is_drawn_where_opencv_projects_it(film: Any, scene: ArScene) -> None:
    frames, lens = film
    frame = frames[0].without_truth()
    registrar = LateRegistrar(RecentBoards(board(), lens), scene.drawn, lens, ArDelay())
    ball = np.array((0.25, 0.12, 0.18))
    registrar.take(frame)
    done = registrar.composed(frame, scene.qpos(scene.robot.home, ball))
    image = done.image.astype(int)
    orange = (image[:, :, 2] - image[:, :, 0] > 60).astype(np.uint8)  # red without blue
    _, _, boxes, _ = cv2.connectedComponentsWithStats(orange)
    x, y, width, height, _ = max(boxes[1:], key=lambda box: box[4])
    middle = np.array((x + 0.5 * (width - 1), y + 0.5 * (height - 1)))
    assert done.pose_camera_board is not None
    camera = scene.drawn.camera(done.pose_camera_board.inverse())
    assert np.linalg.norm(middle - projected(lens, camera.inverse(), ball[None])[0]) < 1.5


@pytest.fixture(scope="module")
def live() -> Iterator[tuple[Session, LiveAr, list[ArPicture]]]:
    """Live pictures of a session that stands still."""
    pictures: list[ArPicture] = []
    with Session(Start("tabletop_puma"), beside=False) as session:
        session.send(MoveGoal((0.2, 0.05, 0.12)))
        for _ in range(3):
            session.tick()
        with LiveAr(session, pictures.append) as made:
            made.show_view(session.view())
            made.switch(True)
            wait_for(lambda: pictures and math.isfinite(pictures[-1].ball[0]), "no picture came")
            yield session, made, pictures


def test_the_mouse_takes_the_ball_along_in_the_plane_of_the_picture(live: Any) -> None:
    _, made, pictures = live
    made.set_delay(ArDelay())
    u, v, radius = pictures[-1].ball
    assert 0.0 < u < 640.0 and 0.0 < v < 480.0 and radius > 2.0
    position = made.ball_at(u, v)
    right = made.ball_at(u + 40.0, v)
    assert position is not None and right is not None
    assert np.linalg.norm(position - (0.2, 0.05, 0.12)) < 0.02, (
        "the board moves between two pictures"
    )
    assert np.linalg.norm(right - position) > 0.01


def test_what_was_compiled_for_the_pictures_is_known(live: Any) -> None:
    assert live and is_warm(), "each session would compile in another process again"


def test_text_is_written_into_the_picture_unless_the_overlay_is_off(live: Any) -> None:
    _, made, pictures = live

    def card(image: Any) -> float:
        """Return how dark the place of the text is."""
        return float(image[-30:-12, 14:40].mean())

    made.writes = False
    count = len(pictures)
    wait_for(lambda: len(pictures) > count + 2)
    without = card(pictures[-1].image)
    made.writes = True
    count = len(pictures)
    wait_for(lambda: len(pictures) > count + 2)
    assert card(pictures[-1].image) < without - 30.0


def test_a_wrong_camera_is_named_and_the_next_one_works(live: Any) -> None:
    _, made, pictures = live
    made.set_setup(ArSetup(camera="no/such/film.mp4"))
    wait_for(lambda: "no camera, file or folder" in made.status.problem)
    made.set_setup(ArSetup(board="grid:9x9"))
    wait_for(lambda: made.status.problem and "film" not in made.status.problem)
    made.set_setup(ArSetup(ball="marker", marker=0))
    wait_for(lambda: "marker 0 is on the board" in made.status.problem)
    count = len(pictures)
    made.set_setup(ArSetup())
    wait_for(lambda: len(pictures) > count + 2 and made.status.board)
    assert made.status.error_px is not None and made.status.problem == ""


def test_the_marker_moves_the_ball_unless_a_passive_figure_acts(live: Any) -> None:
    session, made, pictures = live
    sent: list[Any] = []
    real = session.send
    session.send = sent.append
    try:
        made.set_setup(ArSetup(ball="marker"))
        wait_for(lambda: len(sent) > 2, "the marker moves nothing")
        assert all(isinstance(command, MoveGoal) for command in sent)
        view = session.view()
        figure: Any = type("Locked", (), {"locked": True, "waiting": False, "decision": None})()
        figure.decision = type("Decision", (), dict.fromkeys(("then", "arm"), ""))()
        figure.decision.action = "nothing"
        figure.decision.reason = "a test"
        made.show_view(dataclasses.replace(view, figure=figure))
        count = len(pictures)
        wait_for(lambda: len(pictures) > count + 1)
        sent.clear()
        count = len(pictures)
        wait_for(lambda: len(pictures) > count + 4)
        assert sent == [], "a locked ball was moved"
    finally:
        session.send = real
        made.show_view(session.view())
        made.set_setup(ArSetup())


def test_a_film_is_repeated_at_its_rate_and_its_calibration_is_scaled(tmp_path: Path) -> None:
    file = tmp_path / "clip.avi"
    source, _ = synthetic_scene(320, 240)
    image = source.read().image
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 50.0, (320, 240))
    for _ in range(3):
        writer.write(image)
    writer.release()
    with ArCamera(ArSetup(camera=str(file))) as camera:
        assert "60°" in camera.note
        focal = camera.intrinsics.fx
        assert 2.0 * math.atan(160.0 / focal) == pytest.approx(math.radians(60.0))
        frames = [camera.read() for _ in range(7)]
    assert [frame.sequence for frame in frames] == list(range(1, 8))
    assert all(b.time > a.time for a, b in itertools.pairwise(frames))
    lens = tmp_path / "lens.yaml"
    source.scene.intrinsics.scaled(640, 480).save(lens)
    with ArCamera(ArSetup(camera=str(file), intrinsics=str(lens))) as camera:
        assert camera.note == "" and camera.intrinsics.size == (320, 240)


def test_presets_name_robots_and_commands() -> None:
    chosen = preset("ARKineMan")
    assert chosen is PRESETS["arkineman"] and chosen.ar
    with Session(Start(chosen.robot), beside=False) as session:
        for command in chosen.commands:
            session.send(command)
        session.tick()
        figure = session.view().figure
        assert figure is not None and figure.mode == "active"


def test_the_page_gets_pictures_and_their_status() -> None:
    pytest.importorskip("viser", reason="needs the extra web")
    from robot_ik.testbed.frontends.browser import Page
    from robot_ik.testbed.frontends.page_server import PageServer

    with Session(Start("tabletop_puma"), beside=False) as session:
        session.tick()
        sent: list[Any] = []
        with (
            Page(session, PageServer(port=8735, shadows=False)) as page,
            ChannelClient(page.url) as client,
        ):
            session.send = sent.append  # type: ignore[method-assign]
            page.draw(session.view())
            client.action("show_ar", on=True)
            client.until(lambda one: one.latest["settings"]["ar"]["on"])
            client.until(lambda one: one.pictures, "no picture came")
            number, _, width, height, u, v, radius = HEADER.unpack_from(client.pictures[-1])
            assert (width, height) == (640, 480)
            client.send({"shown": number})
            client.until(lambda one: len(one.pictures) > 1, "no picture after the first")
            client.until(lambda one: one.latest.get("ar", {}).get("board"))
            client.action("drag_ar_ball", u=u, v=v, begins=True)
            wait_for(lambda: any(isinstance(command, MoveGoal) for command in sent))
            sent.clear()
            far = u + 3.0 * (radius + 60.0)
            client.action("drag_ar_ball", u=far, v=v, begins=True)
            client.action("set_ar_delay", seconds=0.2, sync="latest", predict=True, shift=False)
            client.until(lambda one: one.latest["settings"]["ar"]["seconds"] == 0.2)
            assert sent == [], "a mouse far from the ball took it"
            client.action("set_ar_ball", ball="marker", marker=9, marker_size=0.05)
            client.until(lambda one: one.latest["settings"]["ar"]["ball"] == "marker")
            client.action("place_ar", place="corner")
            client.until(lambda one: one.latest["settings"]["ar"]["place"] == "corner")
            client.action("set_ar_camera", camera="none", intrinsics="", board=BOARD, dictionary="")
            client.until(lambda one: "none" in one.latest["ar"]["problem"])
            client.action("set_ar_delay", seconds=9.0, sync="latest", predict=True, shift=False)
            client.until(lambda one: any("seconds" in notice for notice in one.notices))
            client.action("show_ar", on=False)
            client.until(lambda one: one.latest["ar"]["on"] is False)
            sent.clear()
            client.send({"action": "begin_preset", "name": "arkineman"})
            client.until(lambda one: one.latest["settings"]["ar"]["on"])
            assert sent == [SetRobot("humanoid"), SetFigure("active")]
