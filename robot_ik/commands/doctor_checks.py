"""What this machine can do: each check returns rows, opens nothing that moves, and cannot hang.

A row is OK, a NOTE (works, or is not needed, but worth knowing) or a PROBLEM (something robot_ik needs
is broken).
"""

from __future__ import annotations

import functools
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from pathlib import Path

from robot_ik.camera.drawing import probe as drawing_probe
from robot_ik.commands.environment import GL_PACKAGES, OPENCV_WHEELS, graphics_error, version_of
from robot_ik.errors import DISTRIBUTION, install_command
from robot_ik.hardware.checks import NOTE, OK, PROBLEM, CheckRow, permission_hint
from robot_ik.hardware.ports import serial_ports, serial_row

#: Seconds that the whole doctor may take: each child process gets what is left of them.
WHOLE_LIMIT = 9.0
#: A distribution of another project that installs a package of the same import name.
FOREIGN_DISTRIBUTION = "robot-ik"
#: Children at the same time: more only make each other late on a small machine.
WORKERS = 4


CheckFinding = tuple[str, str, str]
"""Of one row: how it is, what was found, what to do about it."""

#: A check takes the moment (``time.monotonic``) at which it must be done.
Check = Callable[[float], CheckFinding | list[CheckRow]]


class LateError(Exception):
    """A check ran out of time, which is no proof of anything being broken."""


def in_time(probe: drawing_probe.Probe) -> drawing_probe.Probe:
    """What a child process found; raises ``LateError`` where it was stopped."""
    if probe.late:
        raise LateError(probe.text.splitlines()[-1])
    return probe


def time_left(until: float) -> float:
    """Seconds for a child process; never none at all, so that it can at least say that it was late."""
    return max(0.2, until - time.monotonic())


def _run(code: str, until: float, environ: Mapping[str, str] | None = None) -> drawing_probe.Probe:
    return in_time(drawing_probe.run_probe(code, timeout=time_left(until), environment=environ))


def check_python(until: float) -> CheckFinding:
    """Which Python this is."""
    return OK, f"{sys.version.split()[0]}, {sys.executable}", ""


def check_packages(until: float) -> CheckFinding:
    """Every package that robot_ik's own metadata requires is installed."""
    required = [text for text in metadata.requires(DISTRIBUTION) or [] if "extra ==" not in text]
    names = [re.split(r"[^A-Za-z0-9._-]", text)[0] for text in required]
    # Of OpenCV any of four wheels will do: see check_opencv.
    versions = {name: version_of(name) for name in names if not name.startswith("opencv")}
    if missing := [name for name, version in versions.items() if not version]:
        return PROBLEM, f"missing: {', '.join(missing)}", install_command()
    return OK, ", ".join(f"{name} {version}" for name, version in versions.items()), ""


def check_distribution(until: float) -> CheckFinding:
    """Another project is called ``robot-ik`` on the package index and installs a ``robot_ik`` of its own."""
    version = version_of(DISTRIBUTION)
    for foreign in metadata.distributions(name=FOREIGN_DISTRIBUTION):
        # A build leaves metadata in its checkout. Only what is installed has a RECORD.
        if foreign.read_text("RECORD") is None:
            continue
        name = f"{FOREIGN_DISTRIBUTION} {foreign.version}"
        found = f"{name} is another project and overwrites the package robot_ik"
        reinstall = f"pip install --force-reinstall --no-deps {DISTRIBUTION}"
        return PROBLEM, found, f"pip uninstall -y {FOREIGN_DISTRIBUTION} && {reinstall}"
    if not version:
        return NOTE, f"{DISTRIBUTION} is not installed; this is a checkout", install_command()
    return OK, f"{DISTRIBUTION} {version}", ""


def check_mujoco(until: float) -> CheckFinding:
    """MuJoCo 4 is an umbrella over mujoco-core; an upgrade across it can leave an empty shell."""
    clean = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
    probe = _run("import mujoco; mujoco.MjModel; print(mujoco.__version__)", until, clean)
    umbrella, core = version_of("mujoco"), version_of("mujoco-core")
    repair = "pip uninstall -y mujoco mujoco-core mujoco-studio && pip install mujoco"
    if not probe.ok:
        return PROBLEM, probe.text, repair
    if core and umbrella and core != umbrella:
        return NOTE, f"mujoco {umbrella} with mujoco-core {core}: mixed versions", repair
    return OK, probe.text, ""


def check_opencv(until: float) -> CheckFinding:
    """One OpenCV wheel, importable, with the marker detector."""
    wheels = [name for name in OPENCV_WHEELS if version_of(name)]
    probe = _run("import cv2; cv2.aruco.ArucoDetector; print(cv2.__version__)", until)
    install = "pip install opencv-contrib-python-headless"
    one = f"pip uninstall -y {' '.join(wheels)} && {install}" if wheels else install
    if not probe.ok:
        return PROBLEM, probe.text, one
    if len(wheels) > 1:
        return NOTE, f"{probe.text}; several wheels share one folder: {', '.join(wheels)}", one
    return OK, f"{probe.text} ({wheels[0] if wheels else 'not from a wheel'})", ""


def check_user_gl(until: float) -> CheckFinding:
    """The user's own ``MUJOCO_GL``: when its library is missing, ``import mujoco`` fails."""
    value = os.environ.get("MUJOCO_GL", "")
    if not value:
        return OK, "not set; robot_ik needs no OpenGL", ""
    if value.lower().strip() in drawing_probe.GL_OFF:
        return OK, f"{value}: OpenGL is switched off", ""
    probe = _run("import mujoco", until)
    if not probe.ok:
        error = graphics_error(value, probe.text)
        return PROBLEM, str(error.args[0]), "; ".join(error.hint.splitlines()[:2])
    drawn = drawing_probe.probe_gl(value, timeout=time_left(until))
    if not drawn.ok:
        return NOTE, f"{value} cannot draw: {drawn.text}", "unset MUJOCO_GL"
    return OK, f"{value}: {drawn.text}", ""


def check_gl(backend: str, until: float) -> CheckFinding:
    """Whether ``mujoco.Renderer`` could draw with this back end (nothing in robot_ik must)."""
    probe = in_time(drawing_probe.probe_gl(backend, timeout=time_left(until)))
    if probe.ok:
        return OK, probe.text, ""
    packages = GL_PACKAGES[backend]
    return NOTE, f"not usable: {probe.text}", f"only for mujoco.Renderer: sudo apt-get install {packages}"


def check_display(until: float) -> CheckFinding:
    """Whether the viewer window (--viewer) can open."""
    probe = in_time(drawing_probe.probe_display(timeout=time_left(until)))
    if not probe.ok:
        return NOTE, probe.text, "only --viewer needs one; pictures are written without it"
    do = "run through mjpython to use --viewer" if sys.platform == "darwin" else ""
    return OK, f"{probe.text} ({os.environ.get('DISPLAY', '')})", do


def check_kernels(until: float) -> CheckFinding:
    """Whether numba imports, and whether compiled kernels can be kept between runs."""
    probe = _run("from robot_ik.kernels.jit import cache_folder; print(cache_folder().parent)", until)
    if not probe.ok:
        return PROBLEM, probe.text, "pip install --force-reinstall numba"
    if Path(probe.text).is_relative_to(tempfile.gettempdir()):
        do = "make the cache folder of your user writable, or set XDG_CACHE_HOME"
        return NOTE, f"kept only in {probe.text}: they compile again after a restart", do
    return OK, f"kept in {probe.text}", ""


def check_terminal(until: float) -> CheckFinding:
    """Whether colours, progress bars and signs other than ASCII can be shown."""
    stream = sys.__stdout__ or sys.stdout  # a progress bar stands in for sys.stdout
    terminal, encoding = stream.isatty(), (stream.encoding or "").lower()
    found = f"{'a terminal' if terminal else 'not a terminal'}, TERM={os.environ.get('TERM', '')}, {encoding}"
    if terminal and "utf" not in encoding:
        return NOTE, found, "set PYTHONIOENCODING=utf-8 for clean tables"
    return OK, found, ""


def run_checks(checks: Mapping[str, Check], limit: float = WHOLE_LIMIT) -> list[CheckRow]:
    """Runs the checks side by side; rows come in the order of the checks, and a crash is a row.

    Args:
        checks: By name; the ones that need a child process and matter most first: they get the most time.
        limit: Seconds for all of them together.
    """
    until = time.monotonic() + limit

    def guarded(name: str) -> list[CheckRow]:
        try:
            found = checks[name](until)
            return found if isinstance(found, list) else [CheckRow(name, *found)]
        except LateError as late:
            return [CheckRow(name, NOTE, f"not checked: {late}", "run it again when the machine is idle")]
        except Exception as error:  # one check must not end the others
            problem = f"could not be checked: {type(error).__name__}: {error}"
            return [CheckRow(name, NOTE, problem, "report this")]

    with ThreadPoolExecutor(max_workers=WORKERS) as pool:
        return [row for rows in pool.map(guarded, checks) for row in rows]


# ------------------------------------------------------------------------------------------
# The doctor's view of serial ports and cameras: permission, latency, who else uses them.
#
# No serial port is opened (opening one can reset the board behind it); cameras are opened for one
# picture in a child process with a time limit.


# Prints a line per camera as it goes, so that what was found survives the time limit.
_CAMERA_CODE = """
import os, sys
os.environ["OPENCV_LOG_LEVEL"] = "SILENT"
import cv2
for path in {paths!r}:
    capture = cv2.VideoCapture(path)
    good, image = capture.read() if capture.isOpened() else (False, None)
    size = f"{{image.shape[1]}}x{{image.shape[0]}}" if good else "no picture"
    print(f"{{path}}={{size}}", flush=True)
    capture.release()
"""


def check_serial(until: float) -> CheckFinding | list[CheckRow]:
    """Serial ports with what stands in the way of using them."""
    rows = [serial_row(p.device, p.description or "serial port", p.vid) for p in serial_ports()]
    return rows or (NOTE, "no USB serial port", "plug the adapter in; --bus pty and sim need none")


def check_cameras(until: float) -> CheckFinding | list[CheckRow]:
    """Cameras that give a picture."""
    if not sys.platform.startswith("linux"):
        return NOTE, "not looked for on this system", "try: robot-ik reach --camera 0"
    from robot_ik.camera.device import find_cameras

    # A camera has a second device node for its metadata, which never gives a picture.
    names = {camera.path: camera.name for camera in find_cameras() if camera.pictures}
    if not names:
        return NOTE, "none", "plug one in; --camera synthetic, a photo or a video need none"
    usable = [p for p in names if os.access(p, os.R_OK | os.W_OK)]
    rows = [
        CheckRow(f"camera {p}", NOTE, "no permission", permission_hint(p)) for p in names if p not in usable
    ]
    results = {}
    if usable:
        probe = drawing_probe.run_probe(_CAMERA_CODE.format(paths=usable), timeout=time_left(until))
        results = dict(line.split("=", 1) for line in probe.text.splitlines() if "=" in line)
    for path in usable:
        result = results.get(path, "no answer in time")
        good = result[:1].isdigit()
        do = "" if good else "in use by another program, or this node carries no pictures"
        found = f"{names[path]}: {result}" if names[path] else result
        rows.append(CheckRow(f"camera {path}", OK if good else NOTE, found, do))
    return rows


_BACKENDS = ("egl", "osmesa") if sys.platform.startswith("linux") else ()

CHECKS: Mapping[str, Check] = {
    "python": check_python,
    "distribution": check_distribution,
    "packages": check_packages,
    "mujoco": check_mujoco,
    "opencv": check_opencv,
    "kernels": check_kernels,
    "MUJOCO_GL": check_user_gl,
    **{f"GL {backend}": functools.partial(check_gl, backend) for backend in _BACKENDS},
    "display": check_display,
    "serial": check_serial,
    "camera": check_cameras,
    "terminal": check_terminal,
}
