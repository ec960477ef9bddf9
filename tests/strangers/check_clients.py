"""Third-party servo clients, unmodified, on the virtual bus: `make strangers`.

Each runs in its own process with its own interpreter (.venv-strangers), against a port served by
``robot-ik sim-bus``. A client that could not be installed is skipped with the message of pip.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent
PYTHON = ROOT / ".venv-strangers" / "bin" / "python"

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="pseudo terminals"),
    pytest.mark.skipif(not PYTHON.exists(), reason="no .venv-strangers: make strangers"),
]

_JOINT = """
[[joints]]
name = "joint{id}"
id = {id}
model = "{model}"
mode = "{mode}"
zero_ticks = 2048
lower_deg = -150.0
upper_deg = 150.0
velocity_deg = 90.0
acceleration_deg = 360.0
"""

Serve = Callable[..., AbstractContextManager[Path]]


@pytest.fixture
def serve(tmp_path: Path) -> Serve:
    """``with serve(models, baud) as link`` serves a bus with servos of these models, ids 1, 2, …"""

    @contextmanager
    def serving(
        models: list[str],
        *options: str,
        baud: int = 1_000_000,
        faults: str = "",
        mode: str = "position",
    ) -> Iterator[Path]:
        arm = tmp_path / "arm.toml"
        link = tmp_path / "port"
        joints = [_JOINT.format(id=k, model=m, mode=mode) for k, m in enumerate(models, 1)]
        head = 'schema = 1\nname = "strangers"\nrobot = "none"\n[bus]\n'
        head += f"baud = {baud}\nwatchdog_ms = 0\n"
        arm.write_text(head + "".join(joints))
        command = [
            sys.executable,
            "-m",
            "robot_ik",
            "sim-bus",
            "--arm",
            str(arm),
            "--link",
            str(link),
        ]
        if faults:
            (tmp_path / "faults.toml").write_text(faults)
            command += ["--faults", str(tmp_path / "faults.toml")]
        child = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True)
        try:
            assert child.stdout is not None
            assert child.stdout.readline().strip() == str(link)
            yield link
        finally:
            child.terminate()
            child.communicate(timeout=30)

    return serving


def run(client: str, *arguments: object) -> str:
    """Run a client and return its output. Skip the test if its package is missing."""
    missing = (PYTHON.parents[1] / "missing.txt").read_text()
    package = {
        "sdk": "dynamixel-sdk",
        "feetech_sdk": "feetech-servo-sdk",
        "rustypot_sts_client": "rustypot",
        "lerobot_bus": "lerobot",
        "lerobot_setup": "lerobot",
        "lerobot_feetech": "lerobot",
        "lerobot_feetech_setup": "lerobot",
    }
    name = package.get(client, client.removesuffix("_client").replace("_", "-"))
    for line in missing.splitlines():
        if line.startswith(name):
            pytest.skip(f"cannot be installed: {line}")
    done = subprocess.run(
        [str(PYTHON), str(HERE / "clients" / f"{client}.py"), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_dynamixel_sdk(serve: Serve) -> None:
    with serve(["XM430-W350"] * 3, "--match-baud", mode="extended_position") as link:
        assert "good" in run("sdk", link)


def test_rustypot(serve: Serve) -> None:
    with serve(["XL330-M288"] * 3) as link:
        assert "good" in run("rustypot_client", link)


def test_dynamixel_python(serve: Serve) -> None:
    with serve(["XC330-T288"] * 3) as link:
        assert "good" in run("dynamixel_python_client", link)


def test_lerobot_sets_a_fresh_motor_up(serve: Serve) -> None:
    with serve(["XL330-M288"], "--match-baud", baud=57_600) as link:
        assert "good" in run("lerobot_setup", link)


def test_lerobot_calibrates_and_drives(serve: Serve) -> None:
    """A hand turns the joints repeatedly while the ranges are recorded."""
    turns = []
    for k in range(200):
        way = (60.0, -120.0, 60.0)[k % 3]
        turns.append(f'[[faults]]\nkind = "turn"\nvalue = {way}\nat_s = {0.1 * k:.2f}\n')
    models = ["XL430-W250", "XL430-W250", "XL330-M288", "XL330-M288", "XL330-M288", "XL330-M288"]
    with serve(models, faults="schema = 1\n" + "".join(turns), mode="extended_position") as link:
        assert "good" in run("lerobot_bus", link)


def hand_turns() -> str:
    """Return a file of faults: a hand turns every joint back and forth for 20 s."""
    ways = (60.0, -120.0, 60.0)
    turns = []
    for k in range(200):
        turns.append(f'[[faults]]\nkind = "turn"\nvalue = {ways[k % 3]}\nat_s = {0.1 * k:.2f}\n')
    return "schema = 1\n" + "".join(turns)


def test_feetech_sdk(serve: Serve) -> None:
    with serve(["STS3215"] * 3, "--match-baud") as link:
        assert "good" in run("feetech_sdk", link)


def test_rustypot_with_feetech_servos(serve: Serve) -> None:
    with serve(["STS3215"] * 3, "--match-baud") as link:
        assert "good" in run("rustypot_sts_client", link)


def test_lerobot_sets_a_fresh_feetech_motor_up(serve: Serve) -> None:
    with serve(["STS3215"], "--match-baud") as link:
        assert "good" in run("lerobot_feetech_setup", link)


def test_lerobot_calibrates_and_drives_feetech_motors(serve: Serve) -> None:
    with serve(["STS3215"] * 6, faults=hand_turns()) as link:
        assert "good" in run("lerobot_feetech", link)
