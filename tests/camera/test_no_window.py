"""No code opens a window of OpenCV, because its headless wheel has none."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: What raises in a headless wheel.
WINDOWS = {
    "imshow",
    "namedWindow",
    "waitKey",
    "destroyAllWindows",
    "setMouseCallback",
    "createTrackbar",
}


def calls_of_windows(source: str) -> set[str]:
    """Names of OpenCV's window functions that are used in a file."""
    return {
        node.attr
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == "cv2"
    } & WINDOWS


def test_pictures_are_written_to_files_and_never_shown_by_opencv() -> None:
    folders = ("robot_ik", "hardware", "models", "examples", "docs")
    files = [file for folder in folders for file in (ROOT / folder).rglob("*.py")]
    users = [file for file in files if "cv2" in file.read_text(encoding="utf-8")]
    assert len(users) > 20
    assert {file.name: used for file in users if (used := calls_of_windows(file.read_text()))} == {}
    assert calls_of_windows("import cv2\ncv2.imshow('a', b)") == {"imshow"}
