"""Draw the pictures of the tutorial.

    python docs/make/start_pictures.py [NAME ...]

The files are written to docs/images/start/. The commands and files are those of the pages in
docs/start/. No OpenGL. A NAME is that of a file without its suffix; by default all are drawn.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray
from terminal import terminal_svg

import robot_ik as rik
from robot_ik.camera.drawing.faces import surface_points
from robot_ik.camera.drawing.framing import fitted_camera, portrait_lens
from robot_ik.camera.drawing.overlay import ORANGE, draw_axes, put_label
from robot_ik.camera.drawing.prints import Print
from robot_ik.camera.drawing.studio import SEAMLESS, Body, photograph
from robot_ik.camera.sheets.sheets import SheetRequest, make_sheet_page
from robot_ik.hardware.config import ArmConfig

DOCS = Path(__file__).resolve().parents[1]
IMAGES = DOCS / "images" / "start"
PAGES = DOCS / "start"

#: Width and height of one drawn robot, px.
SIZE = (480, 400)
#: Azimuth and elevation of the viewpoint for the desk arm, for its turn, and for the PUMA 560.
DESK_VIEW_DEG = (-60.0, 18.0)
SWING_VIEW_DEG = (-90.0, 50.0)
PUMA_VIEW_DEG = (-120.0, 14.0)
#: Radius of the ball at a goal, m.
BALL_RADIUS = 0.012
BALL_COLOUR = (0.93, 0.42, 0.10, 1.0)
#: Width of a picture that `robot-ik reach` wrote, px.
REACH_WIDTH = 1000
JPEG_QUALITY = 88
#: Width of a camera picture and height of a printed sheet, px.
PHOTO_WIDTH = 800
SHEET_HEIGHT = 480
#: Columns of the drawn terminals.
COLUMNS = 84

Image = NDArray[np.uint8]
Drawing = Image | str


def write_blocks(page: Path, folder: Path) -> None:
    """Write the blocks of a page that have a file name into a folder."""
    text = page.read_text(encoding="utf-8")
    for match in re.finditer(r"^```\w+ file=(\S+)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        file = folder / match[1]
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(match[2], encoding="utf-8")


@contextmanager
def workplace() -> Iterator[Path]:
    """Enter an empty folder with the files of the tutorial."""
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        for page in sorted(PAGES.glob("*.md")):
            write_blocks(page, Path(name))
        yield Path(name)


def environment() -> dict[str, str]:
    """Return the environment of the commands: one width of the terminal."""
    return {**os.environ, "COLUMNS": str(COLUMNS), "NO_COLOR": "1"}


def run(command: str, *, code: int = 0) -> str:
    """Run a command of the pages and return what it printed.

    Raises:
        SystemExit: The exit code is not the expected one.
    """
    words = shlex.split(command)
    program = {"robot-ik": ["-m", "robot_ik"], "python": []}[words[0]]
    done = subprocess.run(
        [sys.executable, *program, *words[1:]],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment(),
        check=False,
    )
    if done.returncode != code:
        sys.exit(f"{command}: exit code {done.returncode}\n{done.stdout}")
    return done.stdout


@contextmanager
def served(command: str) -> Iterator[None]:
    """Serve virtual servos as long as the block runs."""
    words = shlex.split(command)[1:]
    child = subprocess.Popen(
        [sys.executable, "-m", "robot_ik", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=environment(),
    )
    try:
        assert child.stdout is not None
        child.stdout.readline()  # the command prints its port when it is ready
        yield
    finally:
        child.terminate()
        child.wait()


def with_ball(robot: rik.Robot, position: tuple[float, ...], radius: float) -> mujoco.MjModel:
    """Return the model with a ball that has no contacts."""
    spec = mujoco.MjSpec.from_file(str(robot.path))
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[radius, 0, 0],
        pos=list(position),
        rgba=list(BALL_COLOUR),
        contype=0,
        conaffinity=0,
    )
    return spec.compile()


def draw(
    model: mujoco.MjModel,
    poses: list[NDArray[np.float64]],
    view_deg: tuple[float, float],
) -> Image:
    """Draw a model at several configurations beside each other.

    Args:
        model: The model.
        poses: qpos (model.nq,) of each picture.
        view_deg: Azimuth and elevation of the camera.
    """
    points = [surface_points(model, qpos) for qpos in poses]
    floor = float(points[0][:, 2].min())
    optics = portrait_lens(*SIZE)
    camera = fitted_camera(np.concatenate(points), view_deg, optics)
    views = [
        photograph([Body(model, qpos)], optics, camera, SEAMLESS, floor=floor).image
        for qpos in poses
    ]
    return np.concatenate(views, axis=1)


def solution() -> Image:
    """Draw the PUMA 560 at home and at the goal of page 1."""
    robot = rik.load_robot("puma560")
    position = (-0.45, -0.10, 0.80)
    goal = rik.PoseGoal("gripper", position=position, wxyz=(0, 1, 0, 0))
    q = rik.solve(robot, goal).require().q
    model = with_ball(robot, position, 3 * BALL_RADIUS)
    return draw(model, [robot.qpos(robot.home), robot.qpos(q)], PUMA_VIEW_DEG)


def first_reach() -> Image:
    """Return the picture of the reach of page 1."""
    return reach("--bus sim")


def offset() -> Image:
    """Return the picture of a reach with a wrong zero of joint 2."""
    return reach("--bus sim --fault zero-offset:joint2=2", code=1)


def reach(options: str, *, code: int = 0) -> Image:
    """Return the picture that `robot-ik reach` writes, at the width of the pages."""
    run(f"robot-ik reach {options} --out reached", code=code)
    picture = cv2.imread("reached/reach.png")
    height = round(picture.shape[0] * REACH_WIDTH / picture.shape[1])
    return cv2.resize(picture, (REACH_WIDTH, height), interpolation=cv2.INTER_AREA)


def desk_zero() -> Image:
    """Draw the desk arm at q = 0."""
    robot = rik.load_robot("desk_arm")
    return draw(robot.model, [robot.qpos(np.zeros(3))], DESK_VIEW_DEG)


def desk_solution() -> Image:
    """Draw the desk arm at the goal of page 2."""
    robot = rik.load_robot("desk_arm")
    position = (0.2, 0.1, 0.2)
    q = rik.solve(robot, rik.PositionGoal("gripper", position)).require().q
    return draw(with_ball(robot, position, BALL_RADIUS), [robot.qpos(q)], DESK_VIEW_DEG)


def desk_home() -> Image:
    """Draw the desk arm at home."""
    robot = rik.load_robot("desk_arm")
    return draw(robot.model, [robot.qpos(robot.home)], DESK_VIEW_DEG)


def desk_reach() -> Image:
    """Return the picture of the reach of page 2."""
    return reach("--robot desk_arm --bus sim")


def scan() -> str:
    """Return the output of a scan for the servos of the desk arm."""
    with served("robot-ik sim-bus --arm desk_arm/arm.toml --link my_port"):
        command = "robot-ik servo scan --bus my_port --arm desk_arm/arm.toml --baud 1000000"
        return terminal_svg(command, run(command), "Output of robot-ik servo scan")


def moved() -> Image:
    """Draw the desk arm before and after the move of page 3."""
    robot = rik.load_robot("desk_arm")
    lift = robot.home[1]
    goal = np.array([np.radians(40.0), lift, np.radians(50.0)])
    return draw(robot.model, [robot.qpos(robot.home), robot.qpos(goal)], DESK_VIEW_DEG)


def execute() -> Image:
    """Plot the commanded and the measured angles of the move of page 3."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    with rik.open_robot("desk_arm", bus="sim") as opened:
        opened.enable()
        start = opened.read().q
        move = rik.joint_move(opened.robot, start, start + 0.5)
        record = rik.execute(move, [opened], source=opened, clock=opened.clock, settle=0.4)
    assert record.measured is not None
    assert record.measured_times is not None

    figure, axes = pyplot.subplots(figsize=(6.6, 3.2), dpi=120)
    for k, joint in enumerate(record.joints):
        colour = f"C{k}"
        axes.plot(record.times, np.degrees(record.commanded[:, k]), colour, ls="--", lw=1)
        measured = np.degrees(record.measured[:, k])
        axes.plot(record.measured_times, measured, colour, lw=1.8, label=joint)
    axes.plot([], [], "0.4", ls="--", lw=1, label="commanded")
    axes.set(xlabel="time, s", ylabel="angle, degrees")
    axes.grid(color="0.9")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, ncol=2)
    figure.tight_layout()
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[:, :, :3]
    pyplot.close(figure)
    return np.ascontiguousarray(pixels[:, :, ::-1])


def stuck() -> str:
    """Return the output of a move with a stripped gear."""
    with served("robot-ik sim-bus --arm desk_arm/arm.toml --link broken_port --fault stuck:elbow"):
        command = "robot-ik servo move elbow=40 --bus broken_port --arm desk_arm/arm.toml"
        return terminal_svg(command, run(command, code=1), "Output of robot-ik servo move")


def so101_ids() -> Image:
    """Draw the SO-101 with the name and the servo id of every joint."""
    robot = rik.load_robot("so101")
    arm = ArmConfig.load("so101")
    qpos = robot.qpos(robot.home)
    points = surface_points(robot.model, qpos)
    optics = portrait_lens(760, 560)
    eye = fitted_camera(points, (-60.0, 16.0), optics)
    floor = float(points[:, 2].min())
    image = photograph([Body(robot.model, qpos)], optics, eye, SEAMLESS, floor=floor).image
    data = mujoco.MjData(robot.model)
    data.qpos[:] = qpos
    mujoco.mj_forward(robot.model, data)
    for joint in arm.joints:
        anchor = data.xanchor[robot.model.joint(joint.name).id]
        x, y = optics.project(eye.inverse().apply(anchor)).ravel()
        cv2.circle(image, (round(x), round(y)), 5, ORANGE, -1, cv2.LINE_AA)
        label = f"{joint.servo.id}  {joint.name}"
        image = put_label(image, label, (round(x) + 12, round(y)))
    return image


def real_scan() -> str:
    """Return the output of a scan for the servos of the SO-101."""
    with served("robot-ik sim-bus --arm so101 --link port"):
        printed = run("robot-ik servo scan --bus port --arm so101 --baud 1000000")
    return terminal_svg("robot-ik servo scan --bus /dev/ttyACM0", printed, "Output of a scan")


def real_monitor() -> str:
    """Return the output of `servo monitor` for the SO-101."""
    with served("robot-ik sim-bus --arm so101 --link port"):
        printed = run("robot-ik servo monitor --bus port --arm so101 --count 1")
    command = "robot-ik servo monitor --bus /dev/ttyACM0 --arm my_so101.toml --count 1"
    return terminal_svg(command, printed, "Output of robot-ik servo monitor")


def write_photo() -> None:
    """Run the first block of page 5: it writes photo.png and camera.yaml."""
    text = (PAGES / "camera.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(import cv2\n.*?)^```$", text, re.MULTILINE | re.DOTALL)
    subprocess.run([sys.executable, "-c", block], check=True)


def narrow(picture: Image) -> Image:
    """Return a camera picture at the width of the pages."""
    height = round(picture.shape[0] * PHOTO_WIDTH / picture.shape[1])
    return cv2.resize(picture, (PHOTO_WIDTH, height), interpolation=cv2.INTER_AREA)


def photo() -> Image:
    """Return the photograph of page 5."""
    write_photo()
    return narrow(cv2.imread("photo.png"))


def detected() -> Image:
    """Return the photograph of page 5 with the detected marker."""
    write_photo()
    lens = "--intrinsics camera.yaml"
    run(f"robot-ik camera detect photo.png {lens} --marker-size 0.10 --id 7 --draw found")
    (file,) = Path("found").glob("*.png")
    return narrow(cv2.imread(str(file)))


def from_photo() -> Image:
    """Return the picture of the reach of page 5."""
    write_photo()
    camera = "--camera photo.png --intrinsics camera.yaml"
    return reach(f"{camera} --marker 7 --marker-size 0.10 --bus sim")


def marker_sheet() -> Image:
    """Return the printed sheet of page 5."""
    page = make_sheet_page(SheetRequest("marker"))
    scale = SHEET_HEIGHT / page.height
    width = round(page.width * scale)
    paper = (0.0, 0.0, float(width), float(SHEET_HEIGHT))
    sheet = Print.of_boxes(page.boxes[:, :4] * scale, paper, page.boxes[:, 4])
    gray = sheet.flat(width, SHEET_HEIGHT)
    image = cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR) if gray.ndim == 2 else gray
    return cv2.copyMakeBorder(image, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(190, 190, 190))


def frames() -> Image:
    """Draw the SO-101 with a camera and a board, and the frames of both and of the base."""
    robot = rik.load_robot("so101")
    board = rik.Pose((0.24, 0.0, 0.002))
    camera = rik.Pose.look_at((0.10, -0.45, 0.42), (0.22, 0.0, 0.05))
    spec = mujoco.MjSpec.from_file(str(robot.path))
    colours = {"board": (0.97, 0.97, 0.97, 1), "camera": (0.16, 0.18, 0.22, 1)}
    sizes = {"board": (0.05, 0.05, 0.002), "camera": (0.035, 0.022, 0.02)}
    for name, pose in (("board", board), ("camera", camera)):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=list(sizes[name]),
            pos=list(pose.position),
            quat=list(pose.wxyz),
            rgba=list(colours[name]),
        )
    model = spec.compile()
    qpos = robot.qpos(robot.home)
    points = surface_points(model, qpos)
    optics = portrait_lens(800, 520)
    eye = fitted_camera(points, (-25.0, 24.0), optics)
    floor = float(surface_points(robot.model, qpos)[:, 2].min())
    image = photograph([Body(model, qpos)], optics, eye, SEAMLESS, floor=floor).image
    world = rik.Pose((0.0, 0.0, 0.0))
    for label, pose in (("world", world), ("board", board), ("camera", camera)):
        image = draw_axes(image, eye.inverse() @ pose, 0.09, optics, label=label)
    return image


def swing() -> Image:
    """Draw the two poses of the program of page 6."""
    robot = rik.load_robot("desk_arm")
    side = robot.home + np.radians([25.0, 0.0, 0.0])
    return draw(robot.model, [robot.qpos(robot.home), robot.qpos(side)], SWING_VIEW_DEG)


def pytest() -> str:
    """Return the output of the tests of page 6."""
    printed = run("python -m pytest -q -p no:cacheprovider")
    # The time differs between machines.
    shown = re.sub(r" in [\d.]+s", "", printed)
    return terminal_svg("python -m pytest -q", shown, "Output of pytest: 2 passed")


def script() -> str:
    """Return the output of the script of page 6."""
    command = "robot-ik run overload"
    return terminal_svg(command, run(command), "Output of robot-ik run overload")


PICTURES: dict[str, Callable[[], Drawing]] = {
    "solution.png": solution,
    "reach.jpg": first_reach,
    "offset.jpg": offset,
    "desk_zero.png": desk_zero,
    "desk_solution.png": desk_solution,
    "desk_home.png": desk_home,
    "desk_reach.jpg": desk_reach,
    "scan.svg": scan,
    "moved.png": moved,
    "execute.png": execute,
    "stuck.svg": stuck,
    "so101_ids.png": so101_ids,
    "real_scan.svg": real_scan,
    "real_monitor.svg": real_monitor,
    "photo.jpg": photo,
    "detected.jpg": detected,
    "from_photo.jpg": from_photo,
    "marker_sheet.png": marker_sheet,
    "frames.png": frames,
    "swing.png": swing,
    "pytest.svg": pytest,
    "run.svg": script,
}


def save(file: Path, drawing: Drawing) -> None:
    """Write a picture in the format of its suffix."""
    if isinstance(drawing, str):
        file.write_text(drawing, encoding="utf-8")
        return
    jpeg = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    png = [cv2.IMWRITE_PNG_COMPRESSION, 9]
    cv2.imwrite(str(file), drawing, jpeg if file.suffix == ".jpg" else png)


def main(names: list[str]) -> None:
    """Draw the pictures of those names, by default all."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    for file_name, make in PICTURES.items():
        if names and Path(file_name).stem not in names:
            continue
        with workplace(), contextlib.redirect_stdout(io.StringIO()):
            drawing = make()
        file = IMAGES / file_name
        save(file, drawing)
        print(f"{file_name}: {file.stat().st_size / 1000:.0f} kB", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
