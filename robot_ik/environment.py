"""What this machine can do: does MuJoCo import, which OpenGL draws, is there a display.

Everything that can hang, abort or print to the terminal is tried in a child process with a time limit;
nothing here changes the process.  (MuJoCo 4.0.0: with ``MUJOCO_GL`` naming a back end whose library is
missing, ``import mujoco`` fails with an ``AttributeError`` about ``glGetError`` or ``eglQueryString``;
without a display ``mujoco.viewer.launch_passive`` waits for ever.)
"""

from __future__ import annotations

import getpass
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from types import ModuleType

from robot_ik.errors import DISTRIBUTION, RobotIkError

#: Debian and Ubuntu packages that bring each back end of ``MUJOCO_GL`` on a bare machine.
_MESA = "libgl1 libgl1-mesa-dri"
GL_PACKAGES = {"egl": "libegl1 libgl1", "osmesa": "libosmesa6", "glfw": _MESA, "glx": _MESA}
#: Values of ``MUJOCO_GL`` that mean "no OpenGL at all".
GL_OFF = ("disable", "disabled", "off", "false", "0")

# Drawing one picture is the only proof that a context works; 16 x 16 pixels are enough.
_RENDER_CODE = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 2'/><geom size='.1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 16, 16)
renderer.update_scene(data)
if renderer.render().max() == 0:
    raise SystemExit("the picture is black")
from OpenGL import GL
print((GL.glGetString(GL.GL_RENDERER) or b"").decode())
renderer.close()
"""

# A hidden window with a context: what the passive viewer will ask for.
_WINDOW_CODE = """
import warnings
warnings.simplefilter("ignore")
import glfw
if not glfw.init():
    raise SystemExit("no display can be opened")
glfw.window_hint(glfw.VISIBLE, False)
window = glfw.create_window(32, 32, "probe", None, None)
if not window:
    raise SystemExit("the display gives no OpenGL window")
print("display opened")
"""


@dataclass(frozen=True)
class Probe:
    """What a child process found out."""

    ok: bool  # it ran to its end
    text: str  # its output when it did; else the last line of its complaint
    late: bool = False  # it was stopped because its time was over, which proves nothing on a busy machine


def run_probe(code: str, *, timeout: float, environment: Mapping[str, str] | None = None) -> Probe:
    """Runs Python ``code`` in a child process that is killed after ``timeout`` seconds."""
    try:
        done = subprocess.run(
            # -P: the current folder must not shadow a package.
            [sys.executable, "-P", "-c", code],
            check=False, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace",
            timeout=timeout, env=environment,
        )  # fmt: skip
    except subprocess.TimeoutExpired as stopped:
        # On POSIX the output of a killed child arrives as bytes even in text mode.
        raw: object = stopped.stdout
        said = raw.decode(errors="replace") if isinstance(raw, bytes) else str(raw or "")
        return Probe(False, f"{said.strip()}\nno answer within {timeout:.1f} s".strip(), late=True)
    except OSError as reason:
        return Probe(False, f"no child process: {reason}")
    if done.returncode == 0:
        return Probe(True, done.stdout.strip())
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    if done.returncode < 0:
        lines.append(f"killed by signal {-done.returncode}")
    last = lines[-1] if lines else f"exit code {done.returncode}"
    return Probe(False, last)


def probe_gl(backend: str, *, timeout: float = 6.0) -> Probe:
    """Draws one picture with ``MUJOCO_GL=backend`` in a child process; the text names the renderer."""
    environment = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
    environment["MUJOCO_GL"] = backend
    return run_probe(_RENDER_CODE, timeout=timeout, environment=environment)


def probe_display(*, timeout: float = 6.0) -> Probe:
    """Opens a hidden OpenGL window in a child process, as the viewer will."""
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        return Probe(False, "neither DISPLAY nor WAYLAND_DISPLAY is set")
    return run_probe(_WINDOW_CODE, timeout=timeout)


def graphics_error(value: str, reason: BaseException | str) -> RobotIkError:
    """The error for ``MUJOCO_GL=value`` when MuJoCo cannot be imported with it."""
    name = value.lower().strip()
    if isinstance(reason, BaseException):
        reason = f"{type(reason).__name__}: {reason}"
    apt = (
        f"or install its library: sudo apt-get install --no-install-recommends {GL_PACKAGES[name]}"
        if name in GL_PACKAGES
        else f"or choose one of: {', '.join(GL_PACKAGES)}"
    )
    return RobotIkError(
        f"MUJOCO_GL={value} is set, and MuJoCo cannot be imported with it ({reason})",
        hint=f"robot_ik needs no OpenGL: unset MUJOCO_GL\n{apt}\nlook closer with: robot-ik doctor",
    )


def import_mujoco() -> ModuleType:
    """The ``mujoco`` module, or an error that says what is wrong with this machine.

    Costs nothing beyond the import itself.

    Raises:
        RobotIkError: ``MUJOCO_GL`` names a back end that is not there, MuJoCo is not installed, or
            only an empty shell of it is (an upgrade across version 4 can leave one).
    """
    try:
        import mujoco
    except Exception as reason:  # MuJoCo fails here with AttributeError, RuntimeError, ImportError, …
        value = os.environ.get("MUJOCO_GL", "")
        if value and not isinstance(reason, ModuleNotFoundError):
            raise graphics_error(value, reason) from reason
        raise RobotIkError(
            f"MuJoCo cannot be imported ({type(reason).__name__}: {reason})",
            hint="install it with: pip install mujoco\nlook closer with: robot-ik doctor",
        ) from reason
    if not hasattr(mujoco, "MjModel"):
        raise RobotIkError(
            "the installed mujoco package is an empty shell (it has no MjModel): two versions were mixed",
            hint="repair: pip uninstall -y mujoco mujoco-core mujoco-studio && pip install mujoco",
        )
    return mujoco


def users_of(device: str) -> dict[int, str]:
    """Programs that have a device file open, by process number; what this user may see, on Linux only.

    Whoever serves a pseudo terminal may keep both of its ends open, and is no user of it by that.
    """
    target, found = os.path.realpath(device), {}
    for process in sorted(Path("/proc").glob("[0-9]*"), key=lambda folder: int(folder.name)):
        try:
            files = list((process / "fd").iterdir())
            opened = sum(os.path.realpath(file) == target for file in files)
            if opened > sum(_serves(file, target) for file in files):
                found[int(process.name)] = (process / "comm").read_text(encoding="utf-8").strip()
        except OSError:
            continue  # the process ended, or belongs to somebody else
    return found


def _serves(file: Path, terminal: str) -> bool:
    """Whether an open file (of /proc) is the other end of a pseudo terminal /dev/pts/N."""
    if not terminal.startswith("/dev/pts/") or os.path.basename(os.path.realpath(file)) != "ptmx":
        return False
    about = (file.parent.parent / "fdinfo" / file.name).read_text(encoding="utf-8")
    return f"tty-index:\t{os.path.basename(terminal)}\n" in about


OK, NOTE, PROBLEM = "ok", "note", "problem"


@dataclass(frozen=True)
class CheckRow:
    """One line of the report: what was checked, how it is, what was found, what to do about it."""

    what: str
    status: str
    found: str
    do: str = ""


def permission_hint(path: str) -> str:
    """What gives this user the right to use the device file."""
    try:
        group = Path(path).group()
    except (KeyError, OSError, NotImplementedError):  # a number without a name; Windows has no groups
        group = ""
    if group in ("", "root", "wheel"):
        return f"you may not read and write {path}: ask for a udev rule that gives it to a group of yours"
    return f"sudo usermod -aG {group} {getpass.getuser()}, then log out and in again"


def named_users_of(path: str) -> list[str]:
    """Programs that have ``path`` open, as ``name (pid)``; only what this user may see, Linux only."""
    return [f"{name} ({number})" for number, name in users_of(path).items()]


OPENCV_WHEELS = (
    "opencv-contrib-python-headless", "opencv-python-headless", "opencv-contrib-python", "opencv-python",
)  # fmt: skip


def version_of(package: str) -> str:
    """Installed version of a distribution, or an empty string."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def installed_versions() -> dict[str, str]:
    """Return the versions of this distribution and its main dependencies, without importing them."""
    opencv = next((name for name in OPENCV_WHEELS if version_of(name)), "opencv")
    names = (DISTRIBUTION, "mujoco", opencv, "numba", "numpy", "dynamixel-sdk")
    return {name: version_of(name) for name in names}
