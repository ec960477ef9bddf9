"""Checks of OpenGL and of the display in a child process.

Everything that can hang, abort or print to the terminal runs in a child process with a time limit.
With MuJoCo 4.0.0, ``import mujoco`` fails if ``MUJOCO_GL`` names a back end whose library is
missing, and ``mujoco.viewer.launch_passive`` hangs without a display.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass

#: Values of ``MUJOCO_GL`` that switch OpenGL off.
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

# A hidden window with a context, as the passive viewer opens it.
_WINDOW_CODE = """
import warnings
warnings.simplefilter("ignore")
import glfw
if not glfw.init():
    raise SystemExit("no display can be opened")
glfw.window_hint(glfw.VISIBLE, False)
window = glfw.create_window(32, 32, "probe", None, None)
if not window:
    raise SystemExit("the display cannot open an OpenGL window")
print("display opened")
"""


@dataclass(frozen=True)
class Probe:
    """Result of a check in a child process.

    Attributes:
        ok: Whether the process ended without an error.
        text: Its output; after an error the last line of its error output.
        late: Whether it was stopped at the time limit. On a busy machine this proves nothing.
    """

    ok: bool
    text: str
    late: bool = False


def run_probe(code: str, *, timeout: float, environment: Mapping[str, str] | None = None) -> Probe:
    """Run Python ``code`` in a child process that is killed after ``timeout`` seconds."""
    try:
        done = subprocess.run(
            # -P: the current folder must not shadow a package.
            [sys.executable, "-P", "-c", code],
            check=False,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout,
            env=environment,
        )
    except subprocess.TimeoutExpired as stopped:
        # On POSIX the output of a killed child arrives as bytes even in text mode.
        raw: object = stopped.stdout
        output = raw.decode(errors="replace") if isinstance(raw, bytes) else str(raw or "")
        return Probe(
            False, f"{output.strip()}\nno answer within {timeout:.1f} s".strip(), late=True
        )
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
    """Draw a picture with ``MUJOCO_GL=backend`` in a child process; the text names the renderer."""
    environment = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
    environment["MUJOCO_GL"] = backend
    return run_probe(_RENDER_CODE, timeout=timeout, environment=environment)


def probe_display(*, timeout: float = 6.0) -> Probe:
    """Open a hidden OpenGL window in a child process, as the viewer does."""
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        return Probe(False, "neither DISPLAY nor WAYLAND_DISPLAY is set")
    return run_probe(_WINDOW_CODE, timeout=timeout)
