"""The running figure: modes, moving and teleporting balls, frames without a front end, tables, the
command."""

import csv
import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pictures

from robot_ik.bench.figure import measure_motion
from robot_ik.commands.main import main
from robot_ik.errors import ConfigError, InvalidGoalError, OutputError
from robot_ik.figure.abilities import Abilities
from robot_ik.figure.decide import HalfSpace
from robot_ik.figure.session import FigureFrame, FigureSession
from robot_ik.jobs.figure import FilmMaker, frames_table, read_balls, record


def play(session: FigureSession, seconds: float) -> list[FigureFrame]:
    return [session.step() for _ in range(round(60.0 * seconds))]


def hand_error(session: FigureSession, frame: FigureFrame) -> float:
    assert frame.decision.arm is not None
    hand = session.figure.robot.measure(frame.q, session.figure.hands[frame.decision.arm])
    return float(np.linalg.norm(hand.position - frame.ball))


def test_active_mode_follows_a_ball_that_moves_and_teleports(abilities: Abilities) -> None:
    session = FigureSession(abilities)
    frames = []
    for k in range(90):  # a ball that glides
        session.set_ball((0.45, -0.25 + 0.3 * np.sin(0.05 * k), 1.2 + 0.2 * np.cos(0.04 * k)))
        frames.append(session.step())
    session.set_ball((0.5, 0.25, 0.2))  # and one that is somewhere else at once
    frames += play(session, 2.5)
    assert frames[-1].decision.action == "bend" and hand_error(session, frames[-1]) <= 0.005
    q, contact = np.array([f.q for f in frames]), np.array([f.contact for f in frames])
    measure = measure_motion(session.figure, q, contact)
    assert measure.slip <= 0.1 and measure.too_fast == 0 and measure.outside_limits == 0
    assert measure.jump <= 2.0 and measure.inside >= 0.99


def test_it_walks_to_a_ball_and_reaches_it(abilities: Abilities) -> None:
    session = FigureSession(abilities, stance=(1.0, -1.0, 0.6))
    session.set_ball((2.4, 0.2, 1.2))
    frames = play(session, 0.1)
    while session.busy and len(frames) < 1200:
        frames.append(session.step())
    actions = list(dict.fromkeys(f.action for f in frames))
    assert "walk" in actions and actions.index("reach") > actions.index("walk")
    assert hand_error(session, frames[-1]) <= 0.005
    q, contact = np.array([f.q for f in frames]), np.array([f.contact for f in frames])
    measure = measure_motion(session.figure, q, contact)
    assert measure.slip <= 0.1 and measure.penetration <= 0.5 and measure.self_contact == 0
    assert measure.too_fast == 0 and measure.inside >= 0.93


def test_a_walk_left_for_another_ball_ends_with_its_next_steps(abilities: Abilities) -> None:
    session = FigureSession(abilities)
    session.set_ball((5.0, 0.0, 1.2))
    frames = play(session, 3.0)
    there = float(frames[-1].q[0])
    session.set_ball((5.0, 3.0, 1.2))
    frames += play(session, 3.5)
    q, contact = np.array([f.q for f in frames]), np.array([f.contact for f in frames])
    assert q[:, 0].max() < there + 2.2  # not to the end of the first walk
    measure = measure_motion(session.figure, q, contact)
    assert measure.slip <= 0.1 and measure.penetration <= 0.5 and measure.too_fast == 0


def test_passive_mode_acts_on_the_ball_as_it_was(abilities: Abilities) -> None:
    session = FigureSession(abilities, mode="passive")
    session.set_ball((0.45, -0.25, 1.2))
    assert all(f.action == "stand" for f in play(session, 0.3))  # nothing before Start
    session.start_passive()
    session.set_ball((0.45, 0.25, 0.8))  # moved while it acts: frozen
    frame = play(session, 1.5)[-1]
    assert frame.ball == pytest.approx([0.45, -0.25, 1.2]) and hand_error(session, frame) <= 0.005
    session.set_mode("active")
    frame = play(session, 2.0)[-1]
    assert frame.ball == pytest.approx([0.45, 0.25, 0.8]) and hand_error(session, frame) <= 0.005
    session.reset()
    frame = play(session, 0.1)[-1]
    assert np.isnan(frame.ball).all() and frame.q == pytest.approx(session.figure.home)
    session.place(2.0, 1.0, 1.5)
    assert session.figure.stance(session.step().q) == pytest.approx([2.0, 1.0, 1.5])


def test_it_does_not_walk_behind_a_wall(abilities: Abilities) -> None:
    session = FigureSession(abilities)
    session.set_ball((2.6, 0.9, 1.2))
    assert session.step().decision.action == "walk"
    session.set_obstacles([HalfSpace((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0))])
    assert session.step().decision.action == "nothing"


def test_the_same_commands_give_the_same_frames(abilities: Abilities) -> None:
    def frames() -> bytes:
        session = FigureSession(abilities)
        session.set_ball((0.5, 0.2, 1.4))
        return b"".join(f.q.tobytes() for f in play(session, 1.0))

    assert frames() == frames()


def test_the_table_of_frames_reads_back_and_claims_true_contacts(abilities: Abilities) -> None:
    session = FigureSession(abilities)
    session.set_ball((0.45, -0.25, 1.3))
    frames = play(session, 0.5)
    text = frames_table(session.figure, frames, seed=7)
    header, body = text.splitlines()[:2], "\n".join(text.splitlines()[2:])
    assert all(line.startswith("# ") for line in header) and "sha256" in header[1]
    rows = list(csv.DictReader(io.StringIO(body)))
    assert len(rows) == 30 and {row["left_contact"] for row in rows} == {"flat"}
    names = [session.figure.model.joint(j).name for j in range(1, session.figure.model.njnt)]
    read = np.array([[float(row[name]) for name in names] for row in rows])
    assert read == pytest.approx(np.array([f.q[7:] for f in frames]), abs=1e-9)
    anchors = np.array([[float(row[f"left_anchor_{axis}"]) for axis in "xyz"] for row in rows])
    assert np.ptp(anchors, axis=0).max() < 1e-5 and abs(anchors[:, 2]).max() < 1e-5
    assert rows[0]["seed"] == "7" and rows[-1]["hand"] == "right"


def test_the_command_prints_decisions_and_writes_frames(
    abilities: Abilities, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    balls = tmp_path / "balls.csv"
    balls.write_text("x,y,z\n0.45,-0.25,1.2\n0.5,-0.2,0.3\n0.5,0.5,3.2\n")
    assert main(["figure", "--balls", str(balls)]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["action"] for row in rows] == ["reach", "bend", "nothing"]
    assert rows[2]["ball"] == [0.5, 0.5, 3.2]
    assert main(["figure", "--balls", str(balls), "--record", str(tmp_path / "film.mp4")]) == 2
    assert "with --balls nothing moves" in capsys.readouterr().err
    assert main(["figure", "--ball", "0.5", "0.5", "3.2", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["errors"] == []
    out = tmp_path / "frames.csv"
    assert main(["figure", "--ball", "0.45", "0.25", "1.1", "--frames", str(out), "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["decisions"][0]["arm"] == "left" and reported["errors"][0]["error_m"] < 0.005
    assert len(out.read_text().splitlines()) == reported["frames"] + 3
    for row in ("1,2", "nan,0,1", "0.5,0,inf"):
        balls.write_text(f"{row}\n")
        with pytest.raises(ConfigError, match="row 1"):
            read_balls(balls)


def test_a_ball_is_three_finite_numbers(abilities: Abilities) -> None:
    session = FigureSession(abilities)
    for ball in ((np.nan, 0.0, 0.0), (0.0, np.inf, 0.0), (0.0, 1.0)):
        with pytest.raises(InvalidGoalError, match="ball"):
            session.set_ball(ball)


def test_a_film_shows_the_figure_its_ball_and_the_whole_reason(abilities: Abilities, tmp_path: Path) -> None:
    session = FigureSession(abilities)
    session.set_ball((1.3, 0.3, 1.2))  # a long reason
    frame = session.step()
    maker = FilmMaker(abilities.figure.robot, size=(480, 480))
    image = maker.picture(frame)
    red = (image[..., 2] > 150) & (image[..., 1] < 80)
    assert image.shape == (480, 480, 3) and red.sum() > 20  # the ball
    card = (image[380:].max(axis=2) < 90).any(axis=0)
    assert not card[-2:].any()  # the card ends inside the picture
    words = " ".join(maker.caption(frame).split("\n"))
    assert words == f"{frame.action} {frame.decision.reason}"
    record(abilities.figure.robot, [frame] * 8, tmp_path / "film.gif")
    with Pictures.open(tmp_path / "film.gif") as film:
        shown = np.asarray(film.convert("RGB"))[..., ::-1].astype(int)
    painted = FilmMaker(abilities.figure.robot, size=(480, 360)).picture(frame)
    assert shown.shape == (360, 480, 3) and np.abs(shown - painted).mean() < 1.0  # grey levels
    with pytest.raises(OutputError):
        record(abilities.figure.robot, [frame] * 8, tmp_path / "film.gif")


def test_a_marker_in_the_pictures_of_a_camera_is_the_ball(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The synthetic camera knows where its marker is: 0.87 m before the figure, 0.44 m to its left."""
    argv = ["figure", "--camera", "synthetic", "--seconds", "0.1", "--json"]
    assert main([*argv, "--frames", str(tmp_path / "frames.csv")]) == 0
    assert json.loads(capsys.readouterr().out)["decisions"][-1]["action"] in ("reach", "walk")
    rows = list(csv.DictReader(line for line in (tmp_path / "frames.csv").open() if line[0] != "#"))
    ball = [float(rows[-1][f"target_{axis}"]) for axis in "xyz"]
    scale = 0.40 / 1.75
    # The board, on which the figure stands, is moved about by some centimetres.
    assert np.abs(np.array(ball) - np.array([0.20, 0.10, 0.28]) / scale).max() < 0.35, ball
    assert main([*argv, "--ar", "--record", str(tmp_path / "ar")]) == 0
    assert len(list((tmp_path / "ar").glob("*.png"))) == 3


def test_the_lion_is_a_figure_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "lion.csv"
    assert (
        main(["figure", "--model", "lion", "--ball", "0.9", "-0.2", "0.6", "--frames", str(out), "--json"])
        == 0
    )
    reported = json.loads(capsys.readouterr().out)
    assert reported["decisions"][0]["arm"].endswith("_paw") and reported["errors"][0]["error_m"] < 0.005
    assert len(out.read_text().splitlines()) >= reported["frames"]


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ("--ball 1 2 3 --path circle", "--path: --ball"), ("--ball nan 0 0", "--ball"),
        ("--ball 0 inf 0", "--ball"), ("--camera synthetic --path circle", "--camera: --path is circle"),
        ("--ar --path circle", "--ar: --path is circle"), ("--place nan 0 0", "--place"),
        ("--ar --ball 0.5 0 1", "--ar: --ball is given, too"), ("--camera 0 --balls x", "--balls is"),
        ("--seconds 0", "--seconds"), ("--path circle --seconds nan", "--seconds"), ("--model puma560", ""),
        ("--model lion --path circle", "--model"), ("--balls missing.csv", "missing.csv"),
        ("--ar --viewer", "--viewer"), ("--camera missing.mp4 --ar", "missing.mp4"), ("--ar --scale -1", ""),
    ],
)  # fmt: skip
def test_wrong_input_is_refused(argv: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["figure", *argv.split()]) == 2
    complaint = capsys.readouterr().err.strip()
    assert complaint and said in complaint


def test_the_figure_knows_no_front_end_camera_or_bus() -> None:
    code = (
        "import sys, robot_ik.figure.session as s;"
        "rooms = ('robot_ik.testbed', 'robot_ik.camera', 'robot_ik.hardware');"
        "bad = [m for m in sys.modules if m.startswith(rooms)];"
        "assert not bad, bad"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
