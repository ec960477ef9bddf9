"""Malformed files: every command names file and key in one sentence, exit code 2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik import load_robot

NESTED = "[" * 1000 + "]" * 1000
DIGITS = "7" * 4400
TOML = {
    "nested": f"schema = {NESTED}",
    "digits": f"schema = {DIGITS}",
    "infinite": "schema = 1e999",
    "nothing": "",
    "no text": "\x00",
}
JSON = {
    "nested": f'{{"schema": {NESTED}}}',
    "digits": f'{{"schema": {DIGITS}}}',
    "infinite": '{"schema": 1e999}',
    "nothing": "",
    "a number": "3",
    "a list": "[1, 2]",
    "null": "null",
}
YAML = {
    "nested": f"image_width: {NESTED}",
    "digits": f"image_width: {DIGITS}",
    "nothing": "",
    "a number": "3",
}
XML = {
    "not a number": '<mujoco><worldbody><body pos="nan 0 0"><joint/></body></worldbody></mujoco>',
    "nothing": "",
    "no model": "[" * 1000,
}
CSV = {
    "long": "time_s,commanded.a\n" + "1" * 200_000 + ",2\n",
    "nothing": "",
    "no number": "time_s,commanded.a\n0,nan\n",
}

COMMANDS: list[tuple[str, str, dict[str, str]]] = [
    ("servo monitor --bus /dev/null --arm FILE", "arm.toml", TOML),
    ("servo move joint1=3 --bus /dev/null --arm FILE", "arm.toml", TOML),
    ("reach --bus sim --arm FILE", "arm.toml", TOML),
    ("run take_a_block --arm FILE", "arm.toml", TOML),
    ("run FILE", "script.toml", TOML),
    ("sim-bus --fault FILE", "faults.toml", TOML),
    ("servo replay FILE --bus /dev/null", "motion.csv", CSV),
    ("camera handeye --samples FILE", "samples.json", JSON),
    ("camera verify --samples FILE", "samples.json", JSON),
    ("camera detect picture.png --marker-size 0.05 --intrinsics FILE", "camera.yaml", YAML),
    ("camera detect picture.png --intrinsics camera.yaml --bodies FILE", "bodies.toml", TOML),
    ("solve --goal 0.3 0 0.3 --robot FILE", "robot.xml", XML),
]


@pytest.mark.parametrize(
    ("line", "name", "kind"),
    [
        pytest.param(line, name, (kind, text), id=f"{line} ({kind})")
        for line, name, texts in COMMANDS
        for kind, text in texts.items()
    ],
)
def test_a_hostile_file_is_wrong_input(
    line: str,
    name: str,
    kind: tuple[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    robot_ik: Any,
) -> None:
    import cv2

    from robot_ik.camera.intrinsics import CameraIntrinsics

    monkeypatch.chdir(tmp_path)
    cv2.imwrite("picture.png", np.full((48, 64), 255, np.uint8))
    CameraIntrinsics(64, 48, 60.0, 60.0, 32.0, 24.0).save("camera.yaml")
    (tmp_path / name).write_text(kind[1])
    run = robot_ik(*line.replace("FILE", name).split())
    run.assert_one_screen_error()
    assert name in run.err and "fault of robot_ik" not in run.err
    if kind[0] == "infinite":
        assert "schema" in run.err


def test_a_cap_of_no_use_is_refused_with_its_key(tmp_path: Path, robot_ik: Any) -> None:
    robot = load_robot("puma560")
    assert robot.arm_file is not None
    text = robot.arm_file.read_text(encoding="utf-8")
    arm = tmp_path / "arm.toml"
    head, key, rest = text.partition("velocity_deg = ")
    assert key
    arm.write_text(head + key + "1e308\n" + rest.partition("\n")[2], encoding="utf-8")
    run = robot_ik("servo", "monitor", "--bus", "/dev/null", "--arm", arm)
    run.assert_one_screen_error()
    assert "arm.toml: joints[0].velocity_deg: 1e+308 is not right" in run.err
