"""Files of a run, read with other readers and compared with the report."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from robot_ik.camera.drawing.overlay import draw_robot
from robot_ik.commands.reach import Reach
from robot_ik.commands.reach_picture import draw_picture, save_files
from robot_ik.commands.reach_report import ReachReport
from robot_ik.errors import OutputError
from robot_ik.files import plain
from robot_ik.workcell import scene
from robot_ik.workcell.results import folder_for_results, results_folder

pytestmark = pytest.mark.usefixtures("light_pictures")

# Key of summary.json -> type of its value. The values of phases that did not run are None.
DOCUMENTED = {
    "schema": int,
    "job": str,
    "created": str,
    "reached": bool,
    "problem": str,
    "robot": dict,
    "bus": str,
    "camera": str,
    "marker": dict,
    "goal": dict,
    "limits": list,
    "solution": dict,
    "motion": dict,
    "following": dict,
    "q": list,
    "read_back": dict,
    "by_camera": dict,
    "verdict": str,
    "bus_counters": dict,
    "folder": str,
}


def strict(text: str) -> Any:
    """JSON without NaN or Infinity."""

    def refuse(name: str) -> float:
        raise AssertionError(f"{name} is no JSON")

    return json.loads(text, parse_constant=refuse)


@pytest.fixture(scope="module")
def saved(healthy: ReachReport, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    files = save_files(healthy, folder)
    assert [file.name for file in files] == ["reach.png", "trajectory.csv", "summary.json"]
    assert sorted(file.name for file in folder.iterdir()) == sorted(file.name for file in files)
    return folder


def check_keys(facts: dict[str, Any]) -> None:
    assert set(facts) == set(DOCUMENTED)
    for key, kind in DOCUMENTED.items():
        assert facts[key] is None or isinstance(facts[key], kind), key


def test_the_summary_has_the_results(healthy: ReachReport, saved: Path) -> None:
    facts = strict((saved / "summary.json").read_text("utf-8"))
    check_keys(facts)
    assert facts["schema"] == 1 and facts["reached"] is True and facts["problem"] is None
    np.testing.assert_array_equal(facts["q"], healthy.judged.q)
    for name in ("read_back", "by_camera"):
        judged = getattr(healthy.judged, name)
        assert facts[name]["position_m"] == judged.position
        assert facts[name]["allowed_position_m"] == judged.allowed.position
        assert facts[name]["passed"] is True
    assert facts["by_camera"]["sigma_position_m"] > 0 == facts["read_back"]["sigma_position_m"]
    assert len(facts["limits"]) == 6 and set(facts["limits"][0]) == {
        "joint",
        "unit",
        "model",
        "servo",
        "arm_file",
        "used",
    }
    assert np.shape(facts["marker"]["covariance"]) == (6, 6) and np.shape(
        facts["marker"]["corners_px"]
    ) == (
        4,
        2,
    )
    assert facts["motion"]["samples"] == len(healthy.execution.times)  # type: ignore[union-attr]
    assert facts["bus_counters"]["timeouts"] == 0


def test_the_table_of_the_motion_reads_back(healthy: ReachReport, saved: Path) -> None:
    run = healthy.execution
    assert run is not None and run.measured is not None
    with (saved / "trajectory.csv").open(newline="") as stream:
        head, *rows = list(csv.reader(stream))
    joints = healthy.robot.joints
    assert head == [
        "time_s",
        *(f"commanded.{j}" for j in joints),
        *(f"measured.{j}" for j in joints),
    ]
    values = np.array(rows, dtype=float)
    np.testing.assert_allclose(
        values, np.column_stack([run.times, run.commanded, run.measured]), atol=1e-7
    )
    assert (np.diff(values[:, 0]) > 0).all()


def test_runs_that_end_early_leave_partial_results(reach: Any, tmp_path: Path) -> None:
    report = reach("blank-marker")
    files = [file.name for file in save_files(report, tmp_path / ".")]
    assert files == ["reach.png", "summary.json"]
    facts = strict((tmp_path / "summary.json").read_text("utf-8"))
    check_keys(facts)
    assert facts["reached"] is False and "marker 7" in facts["problem"] and facts["q"] is None


def test_the_drawn_robot_lies_on_the_seen_one(healthy: ReachReport) -> None:
    """The drawn lines follow the edges of the picture, and not if they are shifted."""
    vision = healthy.vision
    robot = healthy.robot
    assert vision is not None and healthy.judged.q is not None
    for image, q in [(healthy.before, healthy.q_start), (healthy.judged.image, healthy.judged.q)]:
        pose = vision.scene.pose_world_camera
        drawn = draw_robot(
            image,
            robot.model,
            robot.qpos(q),
            vision.scene.intrinsics,
            pose,
            alpha=0.0,
            style="registered",
        )
        lines = np.abs(drawn.astype(int) - image.astype(int)).max(axis=2) > 40
        assert lines.sum() > 1000
        gray = cv2.GaussianBlur(
            cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32), (0, 0), 1.0
        )
        slope = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
        here = slope[lines].mean()
        for shift in [(12, 0), (-12, 0), (0, 12), (0, -12)]:
            assert here > 1.3 * slope[np.roll(lines, shift, axis=(0, 1))].mean()


def test_the_picture_shows_the_outcome(healthy: ReachReport, reach: Any) -> None:
    def bars(report: ReachReport) -> set[tuple[int, ...]]:
        picture = draw_picture(report)
        right = picture[:, picture.shape[1] * 3 // 4]
        return {tuple(colour) for colour in right.tolist()}

    green = (90, 190, 60)
    red = (60, 60, 230)
    good = bars(healthy)
    bad = bars(reach("zero-offset:joint2=2.0"))
    assert green in good and red not in good
    assert red in bad and green not in bad


def test_without_a_camera_there_is_no_picture(
    reach: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from robot_ik.goals import PositionGoal

    monkeypatch.setattr(scene, "_TRIES", 4)  # the search for a camera's pose has a test of its own
    box = tmp_path / "hidden.xml"
    box.write_text(
        '<mujoco><worldbody><body><joint name="j" axis="0 0 1" range="-90 90"/>'
        '<geom size=".2" pos=".3 0 0"/><site name="tip" pos=".3 0 0"/></body></worldbody></mujoco>'
    )
    goal = PositionGoal(None, (0.3 * math.cos(0.5), 0.3 * math.sin(0.5), 0.0))
    report = reach(robot=str(box), goal=goal)
    assert report.ok and draw_picture(report) is None and "no camera" in report.verdict
    check_keys(plain(report.json_object()))


def test_folders_are_named_by_time_and_never_shared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    kept = results_folder("", "reach", Reach.FILES, overwrite=False)
    with kept as first, results_folder("", "reach", Reach.FILES, overwrite=False) as second:
        assert first.parent.name == "runs" and "-reach" in first.name
        assert second != first and first.is_dir() and second.is_dir()
    assert not Path("runs").exists()  # nothing was written


def test_a_folder_is_taken_back_when_it_stays_empty(tmp_path: Path) -> None:
    deep = tmp_path / "a" / "b"
    with pytest.raises(RuntimeError), folder_for_results(deep) as folder:
        assert folder.is_dir()
        raise RuntimeError
    assert not (tmp_path / "a").exists()
    with folder_for_results(deep) as folder:
        (folder / "x").write_text("x")
    assert (deep / "x").exists()
    (tmp_path / "old").mkdir()
    with folder_for_results(tmp_path / "old"):
        pass
    assert (tmp_path / "old").is_dir()  # it was there before
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "deeper"):
        with pytest.raises(OutputError), folder_for_results(path):
            raise AssertionError("never entered")
