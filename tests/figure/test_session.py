"""The running figure: modes, balls that move, frames without a front end, tables, the command."""

import csv
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pictures

from benchmarks.figure.motion import MotionMeasure, measure_motion
from robot_ik.commands.figure_film import FilmMaker, save_film
from robot_ik.commands.figure_recording import save_recording
from robot_ik.commands.main import main
from robot_ik.errors import InvalidGoalError, OutputError
from robot_ik.figure.abilities import Abilities
from robot_ik.figure.session import FigureFrame, FigureSession
from robot_ik.motion import Keyframes


def play(session: FigureSession, seconds: float) -> list[FigureFrame]:
    """Return the frames of a time, s."""
    return [session.step() for _ in range(round(60.0 * seconds))]


def hand_error(session: FigureSession, frame: FigureFrame) -> float:
    """Return the distance of the acting hand and the ball, m."""
    assert frame.decision.arm is not None
    hand = session.figure.robot.measure(frame.q, session.figure.hands[frame.decision.arm])
    return float(np.linalg.norm(hand.position - frame.ball))


def measure_frames(session: FigureSession, frames: list[FigureFrame]) -> MotionMeasure:
    """Return what MuJoCo finds in frames."""
    q = np.array([frame.q for frame in frames])
    contact = np.array([frame.contact for frame in frames])
    return measure_motion(session.figure, q, contact)


def test_active_mode_follows_a_ball_that_moves_and_jumps(abilities: Abilities) -> None:
    session = FigureSession(abilities)
    frames = []
    for k in range(90):
        session.set_ball((0.45, -0.25 + 0.3 * np.sin(0.05 * k), 1.2 + 0.2 * np.cos(0.04 * k)))
        frames.append(session.step())
    session.set_ball((0.5, 0.25, 0.2))
    frames += play(session, 2.5)
    assert frames[-1].decision.action == "bend"
    assert hand_error(session, frames[-1]) <= 0.005
    measure = measure_frames(session, frames)
    assert measure.slip_mm <= 0.1
    assert measure.too_fast == 0
    assert measure.outside_limits == 0
    assert measure.speed_change <= 2.0
    assert measure.inside >= 0.99


def test_it_walks_to_a_ball_and_reaches_it(abilities: Abilities) -> None:
    session = FigureSession(abilities, stance=(1.0, -1.0, 0.6))
    session.set_ball((2.4, 0.2, 1.2))
    frames = play(session, 0.1)
    while session.busy and len(frames) < 1200:
        frames.append(session.step())
    actions = list(dict.fromkeys(frame.action for frame in frames))
    assert "walk" in actions
    assert actions.index("reach") > actions.index("walk")
    assert hand_error(session, frames[-1]) <= 0.005
    measure = measure_frames(session, frames)
    assert measure.slip_mm <= 0.1
    assert measure.penetration_mm <= 0.5
    assert measure.self_contact == 0
    assert measure.too_fast == 0
    assert measure.inside >= 0.93


def test_a_walk_interrupted_by_another_ball_ends_with_its_next_steps(abilities: Abilities) -> None:
    session = FigureSession(abilities)
    session.set_ball((5.0, 0.0, 1.2))
    frames = play(session, 3.0)
    x = float(frames[-1].q[0])
    assert x > 0.5
    session.set_ball((5.0, 3.0, 1.2))
    frames += play(session, 3.5)
    assert max(frame.q[0] for frame in frames) < x + 2.2  # not the end of the first walk
    measure = measure_frames(session, frames)
    assert measure.slip_mm <= 0.1
    assert measure.penetration_mm <= 0.5
    assert measure.too_fast == 0


def test_passive_mode_acts_on_the_frozen_ball(abilities: Abilities) -> None:
    session = FigureSession(abilities, mode="passive")
    session.set_ball((0.45, -0.25, 1.2))
    assert all(frame.action == "stand" for frame in play(session, 0.3))
    session.start_passive()
    session.set_ball((0.45, 0.25, 0.8))
    frame = play(session, 1.5)[-1]
    assert frame.ball == pytest.approx([0.45, -0.25, 1.2])
    assert hand_error(session, frame) <= 0.005
    session.set_mode("active")
    frame = play(session, 2.0)[-1]
    assert frame.ball == pytest.approx([0.45, 0.25, 0.8])
    assert hand_error(session, frame) <= 0.005
    session.reset()
    frame = play(session, 0.1)[-1]
    assert np.isnan(frame.ball).all()
    assert frame.q == pytest.approx(session.figure.home)
    session.place(2.0, 1.0, 1.5)
    assert session.figure.stance(session.step().q) == pytest.approx([2.0, 1.0, 1.5])


def test_a_ball_that_moves_far_during_the_planning_of_a_walk_gets_a_new_decision(
    abilities: Abilities,
) -> None:
    session = FigureSession(abilities)
    session.set_ball((3.0, 0.0, 1.2))
    frame = session.step()
    assert frame.decision.action == "walk"
    assert session.planning
    session.set_ball((0.45, -0.25, 1.2))
    frames = play(session, 1.5)
    assert all(frame.action != "walk" for frame in frames)
    assert hand_error(session, frames[-1]) <= 0.005


def frames_of(abilities: Abilities, ball: tuple[float, float, float]) -> bytes:
    """Return the frames of three seconds about a ball and one behind, as bytes."""
    session = FigureSession(abilities)
    session.set_ball(ball)
    frames = play(session, 1.5)
    session.set_ball((-2.0, 0.3, 1.2))
    frames += play(session, 1.5)
    return b"".join(frame.q.tobytes() for frame in frames)


def test_the_same_balls_give_the_same_frames_beside_other_sessions(abilities: Abilities) -> None:
    """Frames do not depend on when the planner's thread is ready."""
    balls = [(0.5, 0.2, 1.4), (2.0, 0.5, 1.2), (0.2, -0.2, 2.35)]
    separate = [frames_of(abilities, ball) for ball in balls]
    others = [Abilities(abilities.figure.duplicate(), abilities.maps) for _ in range(len(balls))]
    with ThreadPoolExecutor(len(balls)) as pool:
        together = list(pool.map(frames_of, others, balls))
    assert together == separate


def test_a_closed_session_has_no_thread(abilities: Abilities) -> None:
    """The thread of the planner ends with the session."""
    code = (
        "import gc, threading\n"
        "from robot_ik.figure.abilities import load_abilities\n"
        "from robot_ik.figure.figure import load_figure\n"
        "from robot_ik.figure.session import FigureSession\n"
        "session = FigureSession(load_abilities(load_figure()))\n"
        "session.set_ball((0.45, -0.25, 1.2))\n"
        "for _ in range(10): session.step()\n"
        "planners = [t for t in threading.enumerate() if 'planner' in t.name]\n"
        "assert len(planners) == 1, planners\n"
        "del session\n"
        "gc.collect()\n"
        "planners[0].join(60)\n"
        "assert not planners[0].is_alive()\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_recording_reads_back_and_claims_true_contacts(
    abilities: Abilities, tmp_path: Path
) -> None:
    session = FigureSession(abilities)
    session.set_ball((0.45, -0.25, 1.3))
    frames = play(session, 0.5)
    file = tmp_path / "frames.csv"
    robot = session.figure.robot
    save_recording(robot, session.figure, frames, file, seed=7)
    with file.open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 30
    assert {row["left_contact"] for row in rows} == {"flat"}
    assert (Keyframes.load_csv(file, robot).q == [frame.q for frame in frames]).all()
    anchors = np.array([[float(row[f"left_anchor_{axis}"]) for axis in "xyz"] for row in rows])
    assert np.ptp(anchors, axis=0).max() < 1e-5
    assert abs(anchors[:, 2]).max() < 1e-5
    assert "sha256" in rows[0]["text"]
    assert "seed 7" in rows[0]["text"]
    assert rows[-1]["text"] == ""
    assert rows[-1]["hand"] == "right"
    assert [float(rows[-1][f"goal_{axis}"]) for axis in "xyz"] == [0.45, -0.25, 1.3]


def test_the_command_prints_decisions_and_writes_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["figure", "--ball", "0.5", "0.5", "3.2", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["errors"] == []

    out = tmp_path / "frames.csv"
    argv = ["figure", "--ball", "0.45", "0.25", "1.1", "--record", str(out), "--json"]
    assert main(argv) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["decisions"][0]["arm"] == "left"
    assert report["errors"][0]["error_m"] < 0.005
    assert len(out.read_text().splitlines()) == report["frames"] + 1


def test_a_ball_is_three_finite_numbers(abilities: Abilities) -> None:
    session = FigureSession(abilities)
    for ball in ((np.nan, 0.0, 0.0), (0.0, np.inf, 0.0), (0.0, 1.0)):
        with pytest.raises(InvalidGoalError, match="ball"):
            session.set_ball(ball)


def test_a_film_shows_the_figure_its_ball_and_the_whole_reason(
    abilities: Abilities, tmp_path: Path
) -> None:
    robot = abilities.figure.robot
    session = FigureSession(abilities)
    session.set_ball((1.3, 0.3, 1.2))  # a long reason
    frame = session.step()
    maker = FilmMaker(robot, size=(480, 480))
    image = maker.picture(frame)
    is_red = (image[..., 2] > 150) & (image[..., 1] < 80)
    assert image.shape == (480, 480, 3)
    assert is_red.sum() > 20  # the ball
    card = (image[380:].max(axis=2) < 90).any(axis=0)
    assert not card[-2:].any()  # the card ends inside the picture
    words = " ".join(maker.caption(frame).split("\n"))
    assert words == f"{frame.action} {frame.decision.reason}"

    save_film(robot, [frame] * 8, tmp_path / "film.gif")
    with Pictures.open(tmp_path / "film.gif") as film:
        picture = np.asarray(film.convert("RGB"))[..., ::-1].astype(int)
    painted = FilmMaker(robot, size=(480, 360)).picture(frame)
    assert picture.shape == (360, 480, 3)
    assert np.abs(picture - painted).mean() < 1.0  # grey levels
    with pytest.raises(OutputError):
        save_film(robot, [frame] * 8, tmp_path / "film.gif")


def test_a_marker_in_the_pictures_of_a_camera_is_the_ball(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The marker of the synthetic camera is 0.87 m in front of the figure, 0.44 m to its left."""
    frames = tmp_path / "frames.csv"
    argv = ["figure", "--camera", "synthetic", "--seconds", "0.1", "--json"]
    assert main([*argv, "--record", str(frames)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["decisions"][-1]["action"] in ("reach", "walk")
    with frames.open() as file:
        rows = list(csv.DictReader(file))
    ball = [float(rows[-1][f"goal_{axis}"]) for axis in "xyz"]
    scale = 0.40 / 1.75
    # The board under the figure moves by some centimetres.
    assert np.abs(np.array(ball) - np.array([0.20, 0.10, 0.28]) / scale).max() < 0.35, ball
    assert main([*argv, "--video", str(tmp_path / "ar")]) == 0
    assert len(list((tmp_path / "ar").glob("*.png"))) == 3


def test_the_lion_is_a_figure_of_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "lion.csv"
    argv = ["figure", "--robot", "lion", "--ball", "0.9", "-0.2", "0.6", "--json"]
    assert main([*argv, "--record", str(out)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["decisions"][0]["arm"].endswith("_paw")
    assert report["errors"][0]["error_m"] < 0.005
    assert len(out.read_text().splitlines()) >= report["frames"]


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("--ball 1 2 3 --path circle", "--path: --ball is given, too"),
        ("--ball nan 0 0", "--ball"),
        ("--ball 0 inf 0", "--ball"),
        ("--camera synthetic --path circle", "--camera: --path is given, too"),
        ("--camera synthetic --ball 0.5 0 1", "--camera: --ball is given, too"),
        ("--record frames.txt", "has no known suffix"),
        ("--robot-pose nan 0 0", "--robot-pose"),
        ("--robot-pose 0 0 1", "--robot-pose"),
        ("--seconds 0", "--seconds"),
        ("--path circle --seconds nan", "--seconds"),
        ("--robot puma560", ""),
        ("--robot lion --path circle", "--path: lion does not walk"),
        ("--camera synthetic --video a.mp4 --viewer", "--viewer"),
        ("--camera missing.mp4 --video a.mp4", "missing.mp4"),
        ("--camera synthetic --scale -1", "--scale"),
    ],
)
def test_wrong_input_is_refused(
    argv: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["figure", *argv.split()]) == 2
    error = capsys.readouterr().err.strip()
    assert error
    assert message in error


def test_the_figure_imports_no_front_end_camera_or_bus() -> None:
    code = (
        "import sys, robot_ik.figure.session as s;"
        "packages = ('robot_ik.testbed', 'robot_ik.camera', 'robot_ik.hardware');"
        "bad = [m for m in sys.modules if m.startswith(packages)];"
        "assert not bad, bad"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
