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
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from pathlib import Path

from robot_ik import environment
from robot_ik.environment import NOTE, OK, OPENCV_WHEELS, PROBLEM, CheckRow, permission_hint, version_of
from robot_ik.hardware.ports import serial_ports, serial_row

#: Seconds that the whole doctor may take: each child process gets what is left of them.
WHOLE_LIMIT = 9.0
#: Children at the same time: more only make each other late on a small machine.
WORKERS = 4


#: A check takes the moment (``time.monotonic``) at which it must be done.
Check = Callable[[float], list[CheckRow]]


def time_left(until: float) -> float:
    """Seconds for a child process; never none at all, so that it can at least say that it was late."""
    return max(0.2, until - time.monotonic())


def late(what: str, probe: environment.Probe) -> CheckRow:
    """A check that ran out of time is no proof of anything being broken."""
    return CheckRow(
        what, NOTE, f"not checked: {probe.text.splitlines()[-1]}", "run it again when the machine is idle"
    )


def check_python(until: float) -> list[CheckRow]:
    """Which Python this is."""
    return [CheckRow("python", OK, f"{sys.version.split()[0]}, {sys.executable}")]


def check_packages(until: float) -> list[CheckRow]:
    """Every package that robot_ik's own metadata requires is installed."""
    missing: list[str] = []
    present: list[str] = []
    for requirement in metadata.requires("robot_ik") or []:
        if "extra ==" in requirement:
            continue
        match = re.match(r"[A-Za-z0-9._-]+", requirement)
        name = match.group() if match else requirement
        if name.startswith("opencv"):
            continue  # any of four wheels will do: see check_opencv
        version = version_of(name)
        (present if version else missing).append(f"{name} {version}".strip())
    rows = [CheckRow("packages", OK, ", ".join(present))]
    if missing:
        rows.append(CheckRow("packages", PROBLEM, f"missing: {', '.join(missing)}", "pip install robot_ik"))
    return rows


def check_mujoco(until: float) -> list[CheckRow]:
    """MuJoCo 4 is an umbrella over mujoco-core; an upgrade across it can leave an empty shell."""
    clean = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
    code = "import mujoco; mujoco.MjModel; print(mujoco.__version__)"
    probe = environment.run_probe(code, timeout=time_left(until), environment=clean)
    if probe.late:
        return [late("mujoco", probe)]
    umbrella, core = version_of("mujoco"), version_of("mujoco-core")
    repair = "pip uninstall -y mujoco mujoco-core mujoco-studio && pip install mujoco"
    if not probe.ok:
        return [CheckRow("mujoco", PROBLEM, probe.text, repair)]
    if core and umbrella and core != umbrella:
        return [
            CheckRow("mujoco", NOTE, f"mujoco {umbrella} with mujoco-core {core}: mixed versions", repair)
        ]
    return [CheckRow("mujoco", OK, probe.text)]


def check_opencv(until: float) -> list[CheckRow]:
    """One OpenCV wheel, importable, with the marker detector."""
    wheels = [name for name in OPENCV_WHEELS if version_of(name)]
    code = "import cv2; cv2.aruco.ArucoDetector; print(cv2.__version__)"
    probe = environment.run_probe(code, timeout=time_left(until))
    if probe.late:
        return [late("opencv", probe)]
    one = "pip uninstall -y " + " ".join(wheels) + " && pip install opencv-contrib-python-headless"
    if not probe.ok:
        do = one if wheels else "pip install opencv-contrib-python-headless"
        return [CheckRow("opencv", PROBLEM, probe.text, do)]
    if len(wheels) > 1:
        return [
            CheckRow(
                "opencv", NOTE, f"{probe.text}; several wheels share one folder: {', '.join(wheels)}", one
            )
        ]
    return [CheckRow("opencv", OK, f"{probe.text} ({wheels[0] if wheels else 'not from a wheel'})")]


def check_user_gl(until: float) -> list[CheckRow]:
    """The user's own ``MUJOCO_GL``: when its library is missing, ``import mujoco`` fails."""
    value = os.environ.get("MUJOCO_GL", "")
    if not value:
        return [CheckRow("MUJOCO_GL", OK, "not set; robot_ik needs no OpenGL")]
    if value.lower().strip() in environment.GL_OFF:
        return [CheckRow("MUJOCO_GL", OK, f"{value}: OpenGL is switched off")]
    probe = environment.run_probe("import mujoco", timeout=time_left(until))
    if probe.late:
        return [late("MUJOCO_GL", probe)]
    if not probe.ok:
        error = environment.graphics_error(value, probe.text)
        return [CheckRow("MUJOCO_GL", PROBLEM, str(error.args[0]), "; ".join(error.hint.splitlines()[:2]))]
    drawn = environment.probe_gl(value, timeout=time_left(until))
    if not drawn.ok:
        return [CheckRow("MUJOCO_GL", NOTE, f"{value} cannot draw: {drawn.text}", "unset MUJOCO_GL")]
    return [CheckRow("MUJOCO_GL", OK, f"{value}: {drawn.text}")]


def check_gl(backend: str, until: float) -> list[CheckRow]:
    """Whether ``mujoco.Renderer`` could draw with this back end (nothing in robot_ik must)."""
    if not sys.platform.startswith("linux"):
        return []
    probe = environment.probe_gl(backend, timeout=time_left(until))
    if probe.late:
        return [late(f"GL {backend}", probe)]
    if probe.ok:
        return [CheckRow(f"GL {backend}", OK, probe.text)]
    do = f"only for mujoco.Renderer: sudo apt-get install {environment.GL_PACKAGES[backend]}"
    return [CheckRow(f"GL {backend}", NOTE, f"not usable: {probe.text}", do)]


def check_display(until: float) -> list[CheckRow]:
    """Whether the viewer window (--view) can open."""
    probe = environment.probe_display(timeout=time_left(until))
    if probe.late:
        return [late("display", probe)]
    if probe.ok:
        do = "run through mjpython to use --view" if sys.platform == "darwin" else ""
        return [CheckRow("display", OK, f"{probe.text} ({os.environ.get('DISPLAY', '')})", do)]
    return [CheckRow("display", NOTE, probe.text, "only --view needs one; pictures are written without it")]


def check_kernels(until: float) -> list[CheckRow]:
    """Whether numba imports, and whether compiled kernels can be kept between runs."""
    code = "from robot_ik.kernels.jit import cache_folder; print(cache_folder().parent)"
    probe = environment.run_probe(code, timeout=time_left(until))
    if probe.late:
        return [late("kernels", probe)]
    if not probe.ok:
        return [CheckRow("kernels", PROBLEM, probe.text, "pip install --force-reinstall numba")]
    if Path(probe.text).is_relative_to(tempfile.gettempdir()):
        do = "make the cache folder of your user writable, or set XDG_CACHE_HOME"
        return [
            CheckRow("kernels", NOTE, f"kept only in {probe.text}: they compile again after a restart", do)
        ]
    return [CheckRow("kernels", OK, f"kept in {probe.text}")]


def check_terminal(until: float) -> list[CheckRow]:
    """Whether colours, progress bars and signs other than ASCII can be shown."""
    stream = sys.__stdout__ or sys.stdout  # a progress bar stands in for sys.stdout
    terminal, encoding = stream.isatty(), (stream.encoding or "").lower()
    found = f"{'a terminal' if terminal else 'not a terminal'}, TERM={os.environ.get('TERM', '')}, {encoding}"
    if terminal and "utf" not in encoding:
        return [CheckRow("terminal", NOTE, found, "set PYTHONIOENCODING=utf-8 for clean tables")]
    return [CheckRow("terminal", OK, found)]


def run_checks(checks: Sequence[Check], limit: float = WHOLE_LIMIT) -> list[CheckRow]:
    """Runs the checks side by side; rows come in the order of the checks, and a crash is a row.

    Args:
        checks: The ones that need a child process and matter most first: they get the most time.
        limit: Seconds for all of them together.
    """
    until = time.monotonic() + limit

    def guarded(check: Check) -> list[CheckRow]:
        try:
            return check(until)
        except Exception as error:  # one check must not end the others
            name = getattr(check, "__name__", "check").removeprefix("check_")
            return [
                CheckRow(name, NOTE, f"could not be checked: {type(error).__name__}: {error}", "report this")
            ]

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


def check_serial(until: float) -> list[CheckRow]:
    """Serial ports with what stands in the way of using them."""
    rows = [serial_row(p.device, p.description or "serial port", p.vid) for p in serial_ports()]
    if not rows:
        return [
            CheckRow("serial", NOTE, "no USB serial port", "plug the adapter in; --bus pty and sim need none")
        ]
    return rows


def check_cameras(until: float) -> list[CheckRow]:
    """Cameras that give a picture."""
    if not sys.platform.startswith("linux"):
        return [CheckRow("camera", NOTE, "not looked for on this system", "try: robot-ik reach --camera 0")]
    from robot_ik.camera.device import find_cameras

    # A camera has a second device node for its metadata, which never gives a picture.
    names = {camera.path: camera.name for camera in find_cameras() if camera.pictures}
    paths = list(names)
    if not paths:
        return [
            CheckRow("camera", NOTE, "none", "plug one in; --camera synthetic, a photo or a video need none")
        ]
    rows = [
        CheckRow(f"camera {p}", NOTE, "no permission", permission_hint(p))
        for p in paths
        if not os.access(p, os.R_OK | os.W_OK)
    ]
    usable = [p for p in paths if os.access(p, os.R_OK | os.W_OK)]
    if not usable:
        return rows
    probe = environment.run_probe(_CAMERA_CODE.format(paths=usable), timeout=time_left(until))
    results = dict(line.split("=", 1) for line in probe.text.splitlines() if "=" in line)
    for path in usable:
        result = results.get(path, "no answer in time")
        good = result[:1].isdigit()
        do = "" if good else "in use by another program, or this node carries no pictures"
        found = f"{names[path]}: {result}" if names[path] else result
        rows.append(CheckRow(f"camera {path}", OK if good else NOTE, found, do))
    return rows


CHECKS: list[Check] = [
    check_python,
    check_packages,
    check_mujoco,
    check_opencv,
    check_kernels,
    check_user_gl,
    functools.partial(check_gl, "egl"),
    functools.partial(check_gl, "osmesa"),
    check_display,
    check_serial,
    check_cameras,
    check_terminal,
]
