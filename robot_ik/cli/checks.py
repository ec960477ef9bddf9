"""What ``robot-ik doctor`` looks at: each check returns rows, opens nothing that moves, and cannot hang.

A row is OK, a NOTE (works, or is not needed, but worth knowing) or a PROBLEM (something robot_ik needs
is broken).  Only problems make the doctor's exit code 2.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from robot_ik import environment

OK, NOTE, PROBLEM = "ok", "note", "problem"

#: Seconds that the whole doctor may take: each child process gets what is left of them.
WHOLE_LIMIT = 9.0
#: Children at the same time: more only make each other late on a small machine.
WORKERS = 4

OPENCV_WHEELS = (
    "opencv-contrib-python-headless",
    "opencv-python-headless",
    "opencv-contrib-python",
    "opencv-python",
)


@dataclass(frozen=True)
class Row:
    """One line of the report: what was looked at, how it is, what was found, what to do about it."""

    what: str
    status: str
    found: str
    do: str = ""


#: A check takes the moment (``time.monotonic``) at which it must be done.
Check = Callable[[float], list[Row]]


def time_left(until: float) -> float:
    """Seconds for a child process; never none at all, so that it can at least say that it was late."""
    return max(0.2, until - time.monotonic())


def late(what: str, probe: environment.Probe) -> Row:
    """A check that ran out of time is no proof of anything being broken."""
    return Row(
        what, NOTE, f"not checked: {probe.text.splitlines()[-1]}", "run it again when the machine is idle"
    )


def version_of(package: str) -> str:
    """Installed version of a distribution, or an empty string."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def installed_versions() -> dict[str, str]:
    """Versions of robot_ik and of what it stands on, without importing any of it."""
    opencv = next((name for name in OPENCV_WHEELS if version_of(name)), "opencv")
    names = ("robot_ik", "mujoco", opencv, "numba", "numpy", "dynamixel-sdk")
    return {name: version_of(name) for name in names}


def check_python(until: float) -> list[Row]:
    """Which Python this is."""
    return [Row("python", OK, f"{sys.version.split()[0]}, {sys.executable}")]


def check_packages(until: float) -> list[Row]:
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
    rows = [Row("packages", OK, ", ".join(present))]
    if missing:
        rows.append(Row("packages", PROBLEM, f"missing: {', '.join(missing)}", "pip install robot_ik"))
    return rows


def check_mujoco(until: float) -> list[Row]:
    """MuJoCo 4 is an umbrella over mujoco-core; an upgrade across it can leave an empty shell."""
    clean = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
    code = "import mujoco; mujoco.MjModel; print(mujoco.__version__)"
    probe = environment.run_probe(code, timeout=time_left(until), environment=clean)
    if probe.late:
        return [late("mujoco", probe)]
    umbrella, core = version_of("mujoco"), version_of("mujoco-core")
    repair = "pip uninstall -y mujoco mujoco-core mujoco-studio && pip install mujoco"
    if not probe.ok:
        return [Row("mujoco", PROBLEM, probe.text, repair)]
    if core and umbrella and core != umbrella:
        return [Row("mujoco", NOTE, f"mujoco {umbrella} with mujoco-core {core}: mixed versions", repair)]
    return [Row("mujoco", OK, probe.text)]


def check_opencv(until: float) -> list[Row]:
    """One OpenCV wheel, importable, with the marker detector."""
    wheels = [name for name in OPENCV_WHEELS if version_of(name)]
    code = "import cv2; cv2.aruco.ArucoDetector; print(cv2.__version__)"
    probe = environment.run_probe(code, timeout=time_left(until))
    if probe.late:
        return [late("opencv", probe)]
    one = "pip uninstall -y " + " ".join(wheels) + " && pip install opencv-contrib-python-headless"
    if not probe.ok:
        do = one if wheels else "pip install opencv-contrib-python-headless"
        return [Row("opencv", PROBLEM, probe.text, do)]
    if len(wheels) > 1:
        return [
            Row("opencv", NOTE, f"{probe.text}; several wheels share one folder: {', '.join(wheels)}", one)
        ]
    return [Row("opencv", OK, f"{probe.text} ({wheels[0] if wheels else 'not from a wheel'})")]


def check_user_gl(until: float) -> list[Row]:
    """The user's own ``MUJOCO_GL``: when its library is missing, ``import mujoco`` fails."""
    value = os.environ.get("MUJOCO_GL", "")
    if not value:
        return [Row("MUJOCO_GL", OK, "not set; robot_ik needs no OpenGL")]
    if value.lower().strip() in environment.GL_OFF:
        return [Row("MUJOCO_GL", OK, f"{value}: OpenGL is switched off")]
    probe = environment.run_probe("import mujoco", timeout=time_left(until))
    if probe.late:
        return [late("MUJOCO_GL", probe)]
    if not probe.ok:
        error = environment.graphics_error(value, probe.text)
        return [Row("MUJOCO_GL", PROBLEM, str(error.args[0]), "; ".join(error.hint.splitlines()[:2]))]
    drawn = environment.probe_gl(value, timeout=time_left(until))
    if not drawn.ok:
        return [Row("MUJOCO_GL", NOTE, f"{value} cannot draw: {drawn.text}", "unset MUJOCO_GL")]
    return [Row("MUJOCO_GL", OK, f"{value}: {drawn.text}")]


def check_gl(backend: str, until: float) -> list[Row]:
    """Whether ``mujoco.Renderer`` could draw with this back end (nothing in robot_ik must)."""
    if not sys.platform.startswith("linux"):
        return []
    probe = environment.probe_gl(backend, timeout=time_left(until))
    if probe.late:
        return [late(f"GL {backend}", probe)]
    if probe.ok:
        return [Row(f"GL {backend}", OK, probe.text)]
    do = f"only for mujoco.Renderer: sudo apt-get install {environment.GL_PACKAGES[backend]}"
    return [Row(f"GL {backend}", NOTE, f"not usable: {probe.text}", do)]


def check_display(until: float) -> list[Row]:
    """Whether the viewer window (--view) can open."""
    probe = environment.probe_display(timeout=time_left(until))
    if probe.late:
        return [late("display", probe)]
    if probe.ok:
        do = "run through mjpython to use --view" if sys.platform == "darwin" else ""
        return [Row("display", OK, f"{probe.text} ({os.environ.get('DISPLAY', '')})", do)]
    return [Row("display", NOTE, probe.text, "only --view needs one; pictures are written without it")]


def check_kernels(until: float) -> list[Row]:
    """Whether numba imports, and whether compiled kernels can be kept between runs."""
    code = "from robot_ik.kernels.jit import cache_folder; print(cache_folder().parent)"
    probe = environment.run_probe(code, timeout=time_left(until))
    if probe.late:
        return [late("kernels", probe)]
    if not probe.ok:
        return [Row("kernels", PROBLEM, probe.text, "pip install --force-reinstall numba")]
    if Path(probe.text).is_relative_to(tempfile.gettempdir()):
        do = "make the cache folder of your user writable, or set XDG_CACHE_HOME"
        return [Row("kernels", NOTE, f"kept only in {probe.text}: they compile again after a restart", do)]
    return [Row("kernels", OK, f"kept in {probe.text}")]


def check_terminal(until: float) -> list[Row]:
    """Whether colours, progress bars and signs other than ASCII can be shown."""
    terminal = sys.stdout.isatty()
    encoding = (getattr(sys.stdout, "encoding", "") or "").lower()
    found = f"{'a terminal' if terminal else 'not a terminal'}, TERM={os.environ.get('TERM', '')}, {encoding}"
    if terminal and "utf" not in encoding:
        return [Row("terminal", NOTE, found, "set PYTHONIOENCODING=utf-8 for clean tables")]
    return [Row("terminal", OK, found)]


def run_checks(checks: list[Check], limit: float = WHOLE_LIMIT) -> list[Row]:
    """Runs the checks side by side; rows come in the order of the checks, and a crash is a row.

    Args:
        checks: The ones that need a child process and matter most first: they get the most time.
        limit: Seconds for all of them together.
    """
    until = time.monotonic() + limit

    def guarded(check: Check) -> list[Row]:
        try:
            return check(until)
        except Exception as error:  # a doctor must not fall ill
            name = getattr(check, "__name__", "check").removeprefix("check_")
            return [Row(name, NOTE, f"could not be checked: {type(error).__name__}: {error}", "report this")]

    with ThreadPoolExecutor(max_workers=WORKERS) as pool:
        return [row for rows in pool.map(guarded, checks) for row in rows]
