"""Checks of this machine for ``robot-ik doctor``. No check moves an arm or hangs.

The status of a row is OK, NOTE (it works or is not needed, but the user should read it) or PROBLEM
(a part that robot_ik needs does not work). No serial port is opened, because that can reset the
board behind it. Cameras are opened for one picture, in a child process with a time limit.
"""

from __future__ import annotations

import functools
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from pathlib import Path

from robot_ik.camera import device
from robot_ik.camera.drawing import probe as drawing_probe
from robot_ik.commands.environment import GL_PACKAGES, OPENCV_WHEELS, graphics_error, version_of
from robot_ik.errors import DISTRIBUTION, install_command
from robot_ik.hardware.checks import NOTE, OK, PROBLEM, CheckRow, permission_hint
from robot_ik.hardware.ports import serial_ports, serial_row

TIME_LIMIT = 9.0
"""Seconds for all checks. Each child process gets the time that remains."""

SHORTEST_TIME = 0.2
"""Seconds that a child process gets at least, so that it can report that it was late."""

FOREIGN_DISTRIBUTION = "robot-ik"
"""A distribution of another project that installs a package ``robot_ik``."""

WORKERS = 4
"""Child processes at the same time. More of them slow each other down on a small machine."""

GL_BACKENDS = ("egl", "osmesa") if sys.platform.startswith("linux") else ()
"""Back ends of ``mujoco.Renderer`` that draw without a display. They exist on Linux only."""

CheckFinding = tuple[str, str, str]
"""Status, result and advice of one row."""

Check = Callable[[float], CheckFinding | list[CheckRow]]
"""Takes its deadline on ``time.monotonic``, in seconds."""

# It prints a line for each camera at once. The lines before the time limit are kept.
CAMERA_CODE = """
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


class LateError(Exception):
    """A check ran out of time. It proves nothing about the part that was checked."""


def in_time(probe: drawing_probe.Probe) -> drawing_probe.Probe:
    """Return the result of a child process.

    Raises:
        LateError: The child process was stopped at its deadline.
    """
    if probe.late:
        raise LateError(probe.text.splitlines()[-1])
    return probe


def time_left(deadline: float) -> float:
    """Return the seconds that a child process may take."""
    return max(SHORTEST_TIME, deadline - time.monotonic())


def run_code(
    code: str, deadline: float, environment: Mapping[str, str] | None = None
) -> drawing_probe.Probe:
    """Run Python code in a child process, or raise ``LateError``."""
    timeout = time_left(deadline)
    return in_time(drawing_probe.run_probe(code, timeout=timeout, environment=environment))


def check_python(_deadline: float) -> CheckFinding:
    """Report the version and the path of Python."""
    return OK, f"{sys.version.split()[0]}, {sys.executable}", ""


def check_packages(_deadline: float) -> CheckFinding:
    """Check that each package that robot_ik requires is installed."""
    requirements = metadata.requires(DISTRIBUTION) or []
    required = [text for text in requirements if "extra ==" not in text]
    names = [re.split(r"[^A-Za-z0-9._-]", text)[0] for text in required]
    # Any of four distributions provides OpenCV; check_opencv checks them.
    versions = {name: version_of(name) for name in names if not name.startswith("opencv")}
    missing = [name for name, version in versions.items() if not version]
    if missing:
        return PROBLEM, f"missing: {', '.join(missing)}", install_command()
    return OK, ", ".join(f"{name} {version}" for name, version in versions.items()), ""


def check_distribution(_deadline: float) -> CheckFinding:
    """Check that no other project has overwritten the package ``robot_ik``."""
    version = version_of(DISTRIBUTION)
    for foreign in metadata.distributions(name=FOREIGN_DISTRIBUTION):
        # A build leaves metadata in its checkout. Only an installed distribution has a RECORD.
        if foreign.read_text("RECORD") is None:
            continue
        name = f"{FOREIGN_DISTRIBUTION} {foreign.version}"
        found = f"{name} is another project and overwrites the package robot_ik"
        reinstall = f"pip install --force-reinstall --no-deps {DISTRIBUTION}"
        return PROBLEM, found, f"pip uninstall -y {FOREIGN_DISTRIBUTION} && {reinstall}"
    if not version:
        return NOTE, f"{DISTRIBUTION} is not installed; this is a checkout", install_command()
    return OK, f"{DISTRIBUTION} {version}", ""


def check_mujoco(deadline: float) -> CheckFinding:
    """Check that MuJoCo can be imported.

    The package mujoco 4 installs mujoco-core. An upgrade to it can leave a package without content.
    """
    environment = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}
    code = "import mujoco; mujoco.MjModel; print(mujoco.__version__)"
    probe = run_code(code, deadline, environment)
    version = version_of("mujoco")
    core_version = version_of("mujoco-core")
    repair = "pip uninstall -y mujoco mujoco-core mujoco-studio && pip install mujoco"
    if not probe.ok:
        return PROBLEM, probe.text, repair
    if core_version and version and core_version != version:
        return NOTE, f"mujoco {version} with mujoco-core {core_version}: mixed versions", repair
    return OK, probe.text, ""


def check_opencv(deadline: float) -> CheckFinding:
    """Check that OpenCV can be imported with its marker detector, from a single distribution."""
    wheels = [name for name in OPENCV_WHEELS if version_of(name)]
    code = "import cv2; cv2.aruco.ArucoDetector; print(cv2.__version__)"
    probe = run_code(code, deadline)
    repair = "pip install opencv-contrib-python-headless"
    if wheels:
        repair = f"pip uninstall -y {' '.join(wheels)} && {repair}"
    if not probe.ok:
        return PROBLEM, probe.text, repair
    if len(wheels) > 1:
        found = f"{probe.text}; several wheels share one folder: {', '.join(wheels)}"
        return NOTE, found, repair
    return OK, f"{probe.text} ({wheels[0] if wheels else 'not from a wheel'})", ""


def check_user_gl(deadline: float) -> CheckFinding:
    """Check ``MUJOCO_GL`` as the user set it.

    If the library of that back end is missing, ``import mujoco`` fails.
    """
    value = os.environ.get("MUJOCO_GL", "")
    if not value:
        return OK, "not set; robot_ik needs no OpenGL", ""
    if value.lower().strip() in drawing_probe.GL_OFF:
        return OK, f"{value}: OpenGL is switched off", ""
    probe = run_code("import mujoco", deadline)
    if not probe.ok:
        error = graphics_error(value, probe.text)
        return PROBLEM, str(error.args[0]), "; ".join(error.hint.splitlines()[:2])
    picture = drawing_probe.probe_gl(value, timeout=time_left(deadline))
    if not picture.ok:
        return NOTE, f"{value} cannot draw: {picture.text}", "unset MUJOCO_GL"
    return OK, f"{value}: {picture.text}", ""


def check_gl(backend: str, deadline: float) -> CheckFinding:
    """Check whether ``mujoco.Renderer`` can draw with a back end. No command needs it."""
    probe = in_time(drawing_probe.probe_gl(backend, timeout=time_left(deadline)))
    if probe.ok:
        return OK, probe.text, ""
    install = f"only for mujoco.Renderer: sudo apt-get install {GL_PACKAGES[backend]}"
    return NOTE, f"not usable: {probe.text}", install


def check_display(deadline: float) -> CheckFinding:
    """Check whether the window of --viewer can open."""
    probe = in_time(drawing_probe.probe_display(timeout=time_left(deadline)))
    if not probe.ok:
        return NOTE, probe.text, "only --viewer needs one; pictures are written without it"
    advice = "run through mjpython to use --viewer" if sys.platform == "darwin" else ""
    return OK, f"{probe.text} ({os.environ.get('DISPLAY', '')})", advice


def check_kernels(deadline: float) -> CheckFinding:
    """Check that Numba can be imported, and that compiled kernels are kept between runs."""
    code = "from robot_ik.kernels.jit import cache_folder; print(cache_folder().parent)"
    probe = run_code(code, deadline)
    if not probe.ok:
        return PROBLEM, probe.text, "pip install --force-reinstall numba"
    if Path(probe.text).is_relative_to(tempfile.gettempdir()):
        found = f"kept only in {probe.text}: they compile again after a restart"
        advice = "make the cache folder of your user writable, or set XDG_CACHE_HOME"
        return NOTE, found, advice
    return OK, f"kept in {probe.text}", ""


def check_terminal(_deadline: float) -> CheckFinding:
    """Check whether colours, progress bars and characters beyond ASCII can be shown."""
    # The progress display replaces sys.stdout while the checks run.
    stream = sys.__stdout__ or sys.stdout
    encoding = (stream.encoding or "").lower()
    kind = "a terminal" if stream.isatty() else "not a terminal"
    found = f"{kind}, TERM={os.environ.get('TERM', '')}, {encoding}"
    if stream.isatty() and "utf" not in encoding:
        return NOTE, found, "set PYTHONIOENCODING=utf-8 for clean tables"
    return OK, found, ""


def check_serial(_deadline: float) -> CheckFinding | list[CheckRow]:
    """Check permission, latency and present users of each serial port."""
    ports = serial_ports()
    if not ports:
        return NOTE, "no USB serial port", "plug the adapter in; --bus pty and sim need none"
    return [serial_row(port.device, port.description or "serial port", port.vid) for port in ports]


def check_cameras(deadline: float) -> CheckFinding | list[CheckRow]:
    """Check whether each camera gives a picture."""
    if not sys.platform.startswith("linux"):
        return NOTE, "not looked for on this system", "try: robot-ik reach --camera 0"
    # A camera has a second device file for its metadata, which gives no picture.
    names = {camera.path: camera.name for camera in device.find_cameras() if camera.pictures}
    if not names:
        return NOTE, "none", "plug one in; --camera synthetic, a photo or a video need none"

    readable = [path for path in names if os.access(path, os.R_OK | os.W_OK)]
    rows = [
        CheckRow(f"camera {path}", NOTE, "no permission", permission_hint(path))
        for path in names
        if path not in readable
    ]
    sizes = picture_sizes(readable, deadline)
    for path in readable:
        size = sizes.get(path, "no answer in time")
        found = f"{names[path]}: {size}" if names[path] else size
        if size[:1].isdigit():
            rows.append(CheckRow(f"camera {path}", OK, found))
        else:
            advice = "in use by another program, or this node carries no pictures"
            rows.append(CheckRow(f"camera {path}", NOTE, found, advice))
    return rows


def picture_sizes(paths: Sequence[str], deadline: float) -> dict[str, str]:
    """Return the size of a picture of each camera, or the reason for which there is none.

    A camera that gave no answer before the deadline is missing.
    """
    if not paths:
        return {}
    code = CAMERA_CODE.format(paths=paths)
    probe = drawing_probe.run_probe(code, timeout=time_left(deadline))
    lines = [line.split("=", 1) for line in probe.text.splitlines() if "=" in line]
    return {path: size for path, size in lines}


def run_checks(checks: Mapping[str, Check], limit: float = TIME_LIMIT) -> list[CheckRow]:
    """Run checks at the same time. A check that raises an error becomes a row.

    Args:
        checks: Check by name. The first ones start first and get the most time.
        limit: Seconds for all checks.

    Returns:
        The rows, in the order of the checks.
    """
    deadline = time.monotonic() + limit

    def rows_of(name: str) -> list[CheckRow]:
        try:
            finding = checks[name](deadline)
        except LateError as late:
            advice = "run it again when the machine is idle"
            return [CheckRow(name, NOTE, f"not checked: {late}", advice)]
        except Exception as error:  # an error in one check does not end the others
            problem = f"could not be checked: {type(error).__name__}: {error}"
            return [CheckRow(name, NOTE, problem, "report this")]
        return finding if isinstance(finding, list) else [CheckRow(name, *finding)]

    with ThreadPoolExecutor(max_workers=WORKERS) as pool:
        return [row for rows in pool.map(rows_of, checks) for row in rows]


CHECKS: Mapping[str, Check] = {
    "python": check_python,
    "distribution": check_distribution,
    "packages": check_packages,
    "mujoco": check_mujoco,
    "opencv": check_opencv,
    "kernels": check_kernels,
    "MUJOCO_GL": check_user_gl,
    **{f"GL {backend}": functools.partial(check_gl, backend) for backend in GL_BACKENDS},
    "display": check_display,
    "serial": check_serial,
    "camera": check_cameras,
    "terminal": check_terminal,
}
"""All checks by name."""
