"""``robot-ik ar``: pictures in, pictures out, whatever ends it."""

import contextlib
import importlib.util
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from robot_ik.camera.drawing.drawn_robot import Drawing, DrawnRobot
from robot_ik.camera.registration import LatencyOptions, Registrar
from robot_ik.camera.synthetic.board_table import lens, synthetic_scene
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.camera.targets import marker_grid
from robot_ik.errors import (
    CalibrationError,
    ConfigError,
    MarkerNotFoundError,
    MissingExtraError,
    OutputError,
)
from robot_ik.geometry import Pose
from robot_ik.motion.trajectory import Trajectory
from robot_ik.ports import Image
from robot_ik.robot import load_robot
from robot_ik.robot_file import catalogue
from robot_ik.testbed.ar import overlay
from robot_ik.testbed.ar.motion import make_motion, robot_of
from robot_ik.testbed.ar.overlay import ArRequest, run_ar
from robot_ik.testbed.ar.script_motion import play_script
from robot_ik.workcell import films

COUNT = 5


@pytest.fixture(scope="module")
def request_for(tmp_path_factory: pytest.TempPathFactory) -> ArRequest:
    """A folder of five pictures of a board that moves to the right, and its calibration."""
    folder = tmp_path_factory.mktemp("photographs")
    (folder / "frames").mkdir()
    rng = np.random.default_rng(2)
    for k in range(COUNT):
        pose = Pose((0.02 * k - 0.04, 0.05, 0.75), (0.17, 0.985, 0.0, 0.0))
        markers = {
            id: (side, pose.compose(place))
            for id, (side, place) in marker_grid(2, 2, 0.05, 0.012).markers.items()
        }
        image = render_markers(STANDARD_CAMERA, markers, rng, margin=0.12)
        cv2.imwrite(str(folder / "frames" / f"{k}.png"), image)
    STANDARD_CAMERA.save(folder / "camera.yaml")
    return ArRequest(
        camera=str(folder / "frames"),
        intrinsics=folder / "camera.yaml",
        board="grid:2x2:50:12",
        dictionary="DICT_4X4_50",
        scale=0.2,
        out=folder / "out",
        overwrite=True,
    )


def film_of(path: Path) -> list[np.ndarray]:
    capture = cv2.VideoCapture(str(path))
    pictures = []
    while True:
        good, picture = capture.read()
        if not good:
            return pictures
        pictures.append(picture)


def test_a_folder_in_a_folder_out(request_for: ArRequest, tmp_path: Path) -> None:
    report = run_ar(replace(request_for, out=tmp_path / "drawn"))
    assert (report.pictures, report.drawn) == (COUNT, COUNT)
    assert report.reprojection_px < 0.3
    files = sorted((tmp_path / "drawn").iterdir())
    assert [f.name for f in files] == [f"{k:06d}.png" for k in range(COUNT)]
    middles = []
    for k, file in enumerate(files):
        before = cv2.imread(str(Path(request_for.camera) / f"{k}.png"))
        changed = np.abs(cv2.imread(str(file)).astype(int) - before).max(axis=2) > 0
        assert 2000 < changed.sum() < 150_000
        middles.append(np.argwhere(changed).mean(axis=0)[1])
    steps = np.diff(middles)
    assert (np.abs(steps - 0.02 * 800 / 0.75) < 6).all(), "the robot moves with the board"


def test_a_film_is_whole_also_when_the_run_is_interrupted(
    request_for: ArRequest, tmp_path: Path
) -> None:
    if importlib.util.find_spec("av") is None:
        pytest.skip("needs the extra video")

    def stop(done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    report = run_ar(replace(request_for, out=tmp_path / "a.mp4"), stop)
    assert report.interrupted and report.pictures == 3
    assert report.file == tmp_path / "a.mp4"
    assert [f.name for f in tmp_path.iterdir()] == ["a.mp4"]
    pictures = film_of(tmp_path / "a.mp4")
    assert len(pictures) == 3 and pictures[0].shape == (480, 640, 3)


def test_a_run_that_fails_leaves_the_older_film(request_for: ArRequest, tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"older")
    with pytest.raises(ConfigError):
        run_ar(replace(request_for, out=tmp_path / "a.mp4", motion="dance"))
    assert (tmp_path / "a.mp4").read_bytes() == b"older"
    with pytest.raises(OutputError, match="it exists"):
        run_ar(replace(request_for, out=tmp_path / "a.mp4", overwrite=False))
    assert (tmp_path / "a.mp4").read_bytes() == b"older"


def test_without_the_extra_a_film_error_names_the_install_command(
    request_for: ArRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(films.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="'av'"):  # before anything is loaded
        run_ar(replace(request_for, out=tmp_path / "a.mp4", robot="nowhere.xml"))
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        run_ar(replace(request_for, out=tmp_path / "file" / "a.png"))


def test_latest_shows_the_next_picture_and_remedies_bring_the_robot_there(
    request_for: ArRequest, tmp_path: Path
) -> None:
    def middle(name: str, latency_options: LatencyOptions) -> float:
        report = run_ar(
            replace(
                request_for,
                out=tmp_path / f"{name}.png",
                latency_options=latency_options,
                motion="home",
                shadow=False,
            )
        )
        assert report.pictures == (COUNT if latency_options.sync == "tracked" else COUNT - 1)
        before = cv2.imread(str(Path(request_for.camera) / f"{COUNT - 1}.png"))
        changed = (
            np.abs(cv2.imread(str(tmp_path / f"{name}.png")).astype(int) - before).max(axis=2) > 0
        )
        return float(np.argwhere(changed).mean(axis=0)[1])

    right = middle("tracked", LatencyOptions())
    late = middle("latest", LatencyOptions("latest"))
    shifted = middle("shifted", LatencyOptions("latest", shift=True))
    assert right - late > 12
    assert abs(right - shifted) < 0.5 * (right - late), (
        "what stands above the board moves a little otherwise"
    )


def test_a_board_that_is_nowhere_is_an_error(request_for: ArRequest, tmp_path: Path) -> None:
    with pytest.raises(MarkerNotFoundError, match="seen in no picture"):
        run_ar(replace(request_for, board="marker:40:50", out=tmp_path / "o"))


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_all_of_a_robot_is_in_the_pictures_of_the_scene(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    width = 640
    height = 360
    drawings = []
    compose = Registrar.compose

    def watched(*arguments: object) -> tuple[Image, Drawing | None]:
        image, drawing = compose(*arguments)  # type: ignore[arg-type]
        assert drawing is not None
        drawings.append(drawing.robot.mask(width, height))
        return image, drawing

    monkeypatch.setattr(Registrar, "compose", watched)
    run_ar(ArRequest(robot=name, size=(width, height), seconds=0.1, out=tmp_path / "a.png"))
    assert len(drawings) == 3
    for mask in drawings:
        rows = np.flatnonzero(mask.any(axis=1))
        columns = np.flatnonzero(mask.any(axis=0))
        assert rows[0] > 0 and rows[-1] < height - 1 and columns[0] > 0 and columns[-1] < width - 1
        assert rows[-1] - rows[0] > 0.4 * height or columns[-1] - columns[0] > 0.4 * width, (
            "and fills them"
        )


def test_what_is_neither_film_nor_picture_nor_folder_is_an_error(
    request_for: ArRequest, tmp_path: Path
) -> None:
    for name in ("a.webm", "a.csv"):
        with pytest.raises(OutputError, match="of this kind") as reported:
            run_ar(replace(request_for, out=tmp_path / name))
        assert ".mp4" in reported.value.hint and ".png" in reported.value.hint
    assert not list(tmp_path.iterdir())
    (tmp_path / "run.1").mkdir()
    assert run_ar(replace(request_for, out=tmp_path / "run.1")).file == tmp_path / "run.1"


def test_pictures_of_an_earlier_run_are_kept_or_replaced_but_never_mixed(
    request_for: ArRequest, tmp_path: Path
) -> None:
    folder = tmp_path / "o"
    once = replace(request_for, overwrite=False, out=tmp_path / "o")
    run_ar(once)
    (folder / "000777.png").write_bytes(b"older")
    (folder / "notes.txt").write_text("mine")
    before = {f.name: f.read_bytes() for f in folder.iterdir()}
    with pytest.raises(OutputError, match=r"it holds 000000\.png, …") as reported:
        run_ar(once)
    assert "--overwrite" in reported.value.hint
    with pytest.raises(ConfigError, match="dance"):  # it fails before its first picture
        run_ar(replace(once, overwrite=True, motion="dance"))
    assert {f.name: f.read_bytes() for f in folder.iterdir()} == before
    run_ar(replace(once, overwrite=True))
    assert sorted(before.keys() - {"000777.png"}) == sorted(f.name for f in folder.iterdir())


def test_the_reason_of_few_board_pictures_is_reported(
    request_for: ArRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny = ArRequest(size=(160, 120), seconds=0.05, out=tmp_path / "a.png", overwrite=True)
    with pytest.raises(
        MarkerNotFoundError, match=r"seen in no picture(.|\n)*160x120 px: try a larger --size"
    ):
        run_ar(tiny)
    with pytest.raises(
        MarkerNotFoundError, match=r"the synthetic table has the board grid:2x2:50:12\.5"
    ):
        run_ar(replace(tiny, board="marker:7:50", size=(320, 240)))
    track = Registrar.track
    seen = iter([True, True, False, False, False])
    monkeypatch.setattr(
        Registrar, "track", lambda one, frame: track(one, frame) if next(seen) else None
    )
    report = run_ar(replace(request_for, out=tmp_path / "few"))
    assert report.notice.startswith("the board was seen in 2 of 5 pictures only: check --board")


def test_two_runs_at_once_into_one_folder_are_not_mixed(
    request_for: ArRequest, tmp_path: Path
) -> None:
    request = replace(request_for, out=tmp_path / "o")

    def second(done: int, total: int) -> None:
        with pytest.raises(OutputError, match="another run is writing"):
            run_ar(request)

    assert run_ar(request, second).pictures == COUNT == len(list((tmp_path / "o").iterdir()))


def test_a_robot_out_of_view_is_reported(request_for: ArRequest, tmp_path: Path) -> None:
    far = replace(request_for, base=(30.0, 0.0, 0.0, 0.0), out=tmp_path / "far")
    report = run_ar(far)
    assert report.drawn == COUNT and "nothing of the robot is in view" in report.notice
    assert run_ar(replace(request_for, out=tmp_path / "near")).notice == ""


def test_a_real_camera_needs_a_calibration(request_for: ArRequest) -> None:
    with pytest.raises(CalibrationError, match="no calibration"):
        run_ar(replace(request_for, intrinsics=None))


def test_motions(request_for: ArRequest, tmp_path: Path) -> None:
    robot = load_robot("puma560")
    raised = robot.home + np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    Trajectory([0.0, 1.0], [raised, raised], robot.joints).save_csv(tmp_path / "t.csv")
    arm = robot.arm_file
    assert arm is not None
    pictures = {}
    for motion in ("home", "wave", str(tmp_path / "t.csv"), f"{arm}@sim"):
        run_ar(replace(request_for, out=tmp_path / "p.png", motion=motion))
        pictures[motion] = cv2.imread(str(tmp_path / "p.png"))
    assert (pictures["wave"] != pictures["home"]).any()
    assert (pictures[str(tmp_path / "t.csv")] != pictures["home"]).any()
    Trajectory([0.0], [[0.0]], ["elbow"]).save_csv(tmp_path / "other.csv")
    with pytest.raises(ConfigError, match="elbow"):
        run_ar(replace(request_for, motion=str(tmp_path / "other.csv")))
    with pytest.raises(ConfigError, match="'link9'"):
        run_ar(replace(request_for, occluder_geoms=("link9",)))


def test_the_synthetic_scene_and_a_marker_that_is_followed(tmp_path: Path) -> None:
    request = ArRequest(
        motion="follow", size=(640, 480), seconds=1 / 30, out=tmp_path / "a.png", overwrite=True
    )
    report = run_ar(request)
    assert (report.pictures, report.drawn) == (1, 1)
    assert report.reprojection_px < 0.2
    with pytest.raises(ConfigError, match="on the board"):
        run_ar(replace(request, marker=(2, 0.05)))


def test_the_scenes_clock_stands_until_it_is_let_go_on() -> None:
    source, clock = synthetic_scene(64, 48)
    assert source.read().time == source.read().time == 0.0
    clock.sleep_until(0.1)
    assert source.read().time == 0.1
    assert lens(640, 480).scaled(1280, 960).fx == pytest.approx(lens(1280, 960).fx)


SCRIPT = """schema = 1
name = "nod"
robot = "tabletop_puma"

[[steps]]
do = "joints"
joints_deg = {{ joint1 = 20.0 }}

[[steps]]
do = "wait"
seconds = 0.5

[[steps]]
do = "expect"
state = "{state}"
"""


@pytest.mark.parametrize(
    ("state", "notice"), [("enabled", ""), ("fault", "the script failed at 'expect")]
)
def test_a_script_is_played_as_its_servos_turned(state: str, notice: str, tmp_path: Path) -> None:
    path = tmp_path / "nod.toml"
    path.write_text(SCRIPT.format(state=state))
    assert robot_of(str(path)) == "tabletop_puma" == robot_of("overload") and robot_of("wave") == ""
    robot = load_robot("tabletop_puma")
    figure = DrawnRobot(robot.model, Pose(), 1.0)
    with contextlib.ExitStack() as stack:
        motion = make_motion(str(path), robot, figure, stack)
        assert motion.notice[: len(notice) or None] == notice
        moved = play_script(str(path), robot)[0]
        assert motion.seconds == moved.duration
        np.testing.assert_array_equal(
            motion.q(0.5 * moved.duration, None), moved.at(0.5 * moved.duration)
        )
        # from home to 20 degrees with the limits of a servo, then half a second at rest
        assert 0.7 < moved.duration < 3.0 and np.diff(moved.times).max() < 0.02
        np.testing.assert_allclose(moved.q[0], robot.home, atol=2e-3)
        end = robot.home.copy()
        end[0] = np.deg2rad(20.0)
        for q in moved.q[moved.times > moved.duration - 0.3]:
            np.testing.assert_allclose(q, end, atol=4e-3)
        # the synthetic film is as long as the script
        count = overlay._open(ArRequest(size=(64, 48)), figure, motion, stack).total
        assert count == round(30 * moved.duration)
        with pytest.raises(ConfigError, match="is a script of tabletop_puma, and puma560 is drawn"):
            make_motion(str(path), load_robot("puma560"), figure, stack)


def test_a_script_that_waits_nowhere_shows_where_the_arm_stands(tmp_path: Path) -> None:
    path = tmp_path / "still.toml"
    robot = load_robot("tabletop_puma")
    path.write_text(
        SCRIPT[: SCRIPT.index("[[steps]]")] + '[[steps]]\ndo = "expect"\nstate = "enabled"\n'
    )
    moved, notice = play_script(str(path), robot)
    assert len(moved) == 1 and not notice
    np.testing.assert_allclose(moved.q[0], robot.home, atol=2e-3)
