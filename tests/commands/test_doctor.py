"""``robot-ik doctor``: its findings and advice. It neither hangs nor crashes."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from robot_ik.camera import device
from robot_ik.camera.device import CameraDevice
from robot_ik.camera.drawing import probe as drawing_probe
from robot_ik.camera.drawing.probe import Probe
from robot_ik.commands import doctor_checks as doctor
from robot_ik.hardware import checks, ports

SOON = time.monotonic() + 1e6  # later than the end of every test
linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc and /sys")


def test_report_on_this_machine(robot_ik: Any) -> None:
    run = robot_ik("doctor", "--json")
    report = json.loads(run.out)
    assert run.code == 0 and report["ok"] is True and report["schema"] == 1, run.out
    names = [row["what"] for row in report["rows"]]
    for name in (
        "python",
        "distribution",
        "packages",
        "mujoco",
        "opencv",
        "MUJOCO_GL",
        "display",
        "kernels",
        "terminal",
    ):
        assert name in names
    assert {row["status"] for row in report["rows"]} <= {checks.OK, checks.NOTE}
    for row in report["rows"]:
        assert row["found"]
        assert row["status"] == checks.OK or row["do"], row


@linux
def test_the_terminal_is_seen_behind_a_progress_bar() -> None:
    """Which stands in for ``sys.stdout`` while the checks run."""
    master, slave = pty.openpty()
    code = "import sys; from robot_ik.commands.main import main; sys.exit(main(['doctor']))"
    environ = os.environ | {"TERM": "xterm", "PYTHONIOENCODING": "latin-1"}
    with open(master, "rb", buffering=0) as screen:
        child = subprocess.Popen(
            [sys.executable, "-c", code], stdin=slave, stdout=slave, stderr=slave, env=environ
        )
        os.close(slave)
        shown = b""
        with contextlib.suppress(OSError):  # its other end is closed
            while part := screen.read(4096):
                shown += part
        child.wait()
    assert (
        b"a terminal, TERM=xterm, iso8859-1" in shown or b"a terminal, TERM=xterm, latin-1" in shown
    )
    assert b"not a terminal" not in shown and b"PYTHONIOENCODING=utf-8" in shown


def fake_checks(monkeypatch: pytest.MonkeyPatch, *rows: checks.CheckRow) -> None:
    monkeypatch.setattr(doctor, "CHECKS", {"all": lambda until: list(rows)})


def test_a_problem_has_exit_code_2_and_advice(
    robot_ik: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_checks(
        monkeypatch,
        checks.CheckRow("mujoco", checks.PROBLEM, "gone", "pip install [mujoco]"),
        checks.CheckRow("x", "ok", "y"),
    )
    run = robot_ik("doctor")
    assert run.code == 2 and "pip install [mujoco]" in run.out and "1 problem" in run.out
    run = robot_ik("doctor", "--json")
    assert run.code == 2 and json.loads(run.out)["ok"] is False


def test_notes_are_no_failure(robot_ik: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_checks(monkeypatch, checks.CheckRow("display", checks.NOTE, "none", "only for --view"))
    assert robot_ik("doctor").code == 0


def test_a_check_that_crashes_becomes_a_row() -> None:
    def check_ill(until: float) -> list[checks.CheckRow]:
        raise RuntimeError("oops")

    rows = doctor.run_checks({"ill": check_ill, "python": doctor.check_python})
    assert rows[0].status == checks.NOTE and "oops" in rows[0].found and rows[0].what == "ill"
    assert rows[1].status == checks.OK


def test_it_never_takes_longer_than_it_may() -> None:
    """Ten children that would sleep for ten minutes each: the later ones get the remaining time."""

    def slow(until: float) -> doctor.CheckFinding:
        late = drawing_probe.run_probe(
            "import time; time.sleep(600)", timeout=doctor.time_left(until)
        )
        doctor.in_time(late)
        return checks.OK, "not late", ""

    started = time.monotonic()
    rows = doctor.run_checks({f"slow {k}": slow for k in range(10)}, limit=3.0)
    assert len(rows) == 10 and time.monotonic() - started < 300  # one after the other: 6000 s
    assert {row.status for row in rows} == {checks.NOTE}


@pytest.mark.parametrize("name", ["mujoco", "opencv", "kernels", "MUJOCO_GL", "display"])
def test_a_late_answer_is_no_problem(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setenv("DISPLAY", ":0")
    probes(monkeypatch, Probe(False, "something\nno answer within 7.0 s", late=True))
    (row,) = doctor.run_checks({name: doctor.CHECKS[name]})
    assert row.what == name and row.status == checks.NOTE and "not checked: no answer" in row.found
    assert row.do


def probes(monkeypatch: pytest.MonkeyPatch, probe: Probe) -> None:
    monkeypatch.setattr(drawing_probe, "run_probe", lambda *a, **k: probe)


def versions(monkeypatch: pytest.MonkeyPatch, **known: str) -> None:
    monkeypatch.setattr(doctor, "version_of", lambda name: known.get(name.replace("-", "_"), ""))


def test_an_empty_mujoco_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    probes(monkeypatch, Probe(False, "AttributeError: module 'mujoco' has no attribute 'MjModel'"))
    status, _, do = doctor.check_mujoco(SOON)
    assert status == checks.PROBLEM and "uninstall" in do


def test_mixed_mujoco_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    probes(monkeypatch, Probe(True, "4.0.0"))
    versions(monkeypatch, mujoco="4.0.0", mujoco_core="4.0.1")
    status, found, do = doctor.check_mujoco(SOON)
    assert status == checks.NOTE and "4.0.1" in found and "uninstall" in do


def test_two_opencv_wheels(monkeypatch: pytest.MonkeyPatch) -> None:
    probes(monkeypatch, Probe(True, "5.0.0"))
    versions(monkeypatch, opencv_python="5.0", opencv_contrib_python_headless="5.0")
    status, _, do = doctor.check_opencv(SOON)
    assert status == checks.NOTE
    assert "pip uninstall -y opencv-contrib-python-headless opencv-python &&" in do


def test_opencv_that_does_not_load(monkeypatch: pytest.MonkeyPatch) -> None:
    probes(monkeypatch, Probe(False, "ImportError: libGL.so.1"))
    versions(monkeypatch, opencv_python="5.0")
    status, found, do = doctor.check_opencv(SOON)
    assert status == checks.PROBLEM and "libGL.so.1" in found and "headless" in do


def test_missing_package(monkeypatch: pytest.MonkeyPatch) -> None:
    real = doctor.version_of
    monkeypatch.setattr(
        doctor, "version_of", lambda name: "" if name == "dynamixel-sdk" else real(name)
    )
    status, found, _ = doctor.check_packages(SOON)
    assert status == checks.PROBLEM and found == "missing: dynamixel-sdk"


def install_fake(folder: Path, name: str, version: str) -> None:
    """Write the metadata of a distribution, as an installer does."""
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (info / "RECORD").write_text("robot_ik/__init__.py,,\n")


def test_our_own_distribution_is_found() -> None:
    status, found, _ = doctor.check_distribution(SOON)
    assert status == checks.OK and found.startswith("robot-ik-testbed ")


@pytest.mark.parametrize("name", ["robot-ik", "robot_ik"])
def test_another_project_with_our_import_name_is_a_problem(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install_fake(tmp_path, name, "0.4.0")
    monkeypatch.syspath_prepend(tmp_path)
    status, found, do = doctor.check_distribution(SOON)
    assert status == checks.PROBLEM and "robot-ik 0.4.0 is another project" in found
    assert do.startswith("pip uninstall -y robot-ik && ") and do.endswith(" robot-ik-testbed")


def test_metadata_that_a_build_left_behind_is_no_problem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "robot_ik.egg-info"
    info.mkdir()
    (info / "PKG-INFO").write_text("Metadata-Version: 2.1\nName: robot_ik\nVersion: 0.1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert doctor.check_distribution(SOON)[0] == checks.OK


def test_a_checkout_that_is_not_installed_is_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "version_of", lambda name: "")
    status, _, do = doctor.check_distribution(SOON)
    assert status == checks.NOTE and do == "pip install robot-ik-testbed"


def test_broken_mujoco_gl_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "bogus")
    status, found, do = doctor.check_user_gl(SOON)
    assert status == checks.PROBLEM and "unset MUJOCO_GL" in do and "bogus" in found


def test_gl_switched_off_is_fine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "off")
    assert doctor.check_user_gl(SOON)[0] == checks.OK


@linux
def test_free_port_then_used_port() -> None:
    master, slave = pty.openpty()
    path = os.ttyname(slave)
    client = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        used = ports.serial_row(path, "a pty")
        assert used.status == checks.NOTE and f"({os.getpid()})" in used.found
    finally:
        os.close(client)
    try:  # a program that serves the terminal has both ends open and does not count
        assert checks.named_users_of(path) == []
        assert ports.serial_row(path, "a pty").status == checks.OK
    finally:
        os.close(master)
        os.close(slave)


@linux
@pytest.mark.parametrize(
    ("text", "status"), [("16\n", checks.NOTE), ("1\n", checks.OK), ("?", checks.OK)]
)
def test_latency_timer(
    text: str, status: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = tmp_path / "ttyUSB7"
    port.write_text("")
    monkeypatch.setattr(ports, "USB_SERIAL", tmp_path / "devices")
    timer = tmp_path / "devices/ttyUSB7/latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text(text)
    row = ports.serial_row(str(port), "FTDI")
    assert row.status == status
    assert ("ttyUSB7/latency_timer" in row.do) == (status == checks.NOTE)


def test_port_without_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *a, **k: False)
    monkeypatch.setattr(Path, "group", lambda path: "dialout")
    row = ports.serial_row(str(tmp_path / "ttyACM0"), "U2D2")
    assert row.status == checks.NOTE and "usermod -aG dialout" in row.do
    monkeypatch.setattr(Path, "group", lambda path: "root")
    assert "usermod" not in ports.serial_row("x", "y").do  # no user should join the group root


@linux
def test_camera_that_hangs_leaves_the_others(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    nodes = [str(tmp_path / f"video{k}") for k in range(2)]
    for node in nodes:
        Path(node).write_text("")
    metadata = CameraDevice(2, str(tmp_path / "video2"), "Webcam", "", True, False)
    cameras = [CameraDevice(k, node, "Webcam", "", True, True) for k, node in enumerate(nodes)]
    monkeypatch.setattr(device, "find_cameras", lambda: (*cameras, metadata))
    probes(monkeypatch, Probe(False, f"{nodes[0]}=640x480\nno answer within 7 s"))
    first, second = doctor.check_cameras(SOON)
    assert first.status == checks.OK and first.found == "Webcam: 640x480"
    assert second.status == checks.NOTE and "no answer" in second.found


@linux
def test_camera_probe_with_real_opencv(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    node = tmp_path / "video0"
    node.write_text("not a camera")
    monkeypatch.setattr(
        device, "find_cameras", lambda: (CameraDevice(0, str(node), "", "", True, True),)
    )
    (row,) = doctor.check_cameras(SOON)
    assert row.status == checks.NOTE and "no picture" in row.found
