"""The check of a simulated arm by a camera: errors, hidden zero offsets, reports."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from benchmarks.camera import arm
from benchmarks.camera.rows import Effort
from robot_ik.camera.calibration.extrinsics import CameraExtrinsics
from robot_ik.camera.calibration.kinematic import PoseError
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.targets import MarkerTarget
from robot_ik.errors import CalibrationError, ConfigError, MarkerNotFoundError, UnknownJointError
from robot_ik.hardware.calibration_file import zeros_moved
from robot_ik.hardware.config import ArmConfig
from robot_ik.workcell import vision
from robot_ik.workcell.arm_camera import camera_and_board, stations, verify
from robot_ik.workcell.arm_camera.error_map import draw_arrows, error_picture, regions, summary
from robot_ik.workcell.arm_camera.verify import VerifyReport, VerifyRequest, run_verify
from robot_ik.workcell.robot_setup import Rehearsal
from tests.workcell.arm_camera.drawn_camera import DrawnCamera, use_drawn_camera

#: Hidden zero offsets, degrees.
HIDDEN = {
    "joint1": 2.0,
    "joint2": -2.5,
    "joint3": 1.5,
    "joint4": -3.0,
    "joint5": 2.0,
    "joint6": 1.0,
}


@pytest.fixture(autouse=True, scope="module")
def _drawn_camera() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        use_drawn_camera(patch)
        yield


@pytest.fixture(scope="module")
def report(_drawn_camera: None) -> VerifyReport:
    """Return a report with fitted zero offsets. It is made once."""
    return run_verify(
        VerifyRequest("tabletop_puma", views=7, fit=True, seed=3, rehearsal=Rehearsal(HIDDEN))
    )


def extrinsics_of(report: VerifyReport, method: str = "board") -> CameraExtrinsics:
    """Return the pose of the camera of a report."""
    camera = report.samples.camera
    return CameraExtrinsics(
        camera.pose,
        "world",
        camera.covariance,
        0.1,
        0.1,
        "2026-01-01",
        STANDARD_CAMERA.digest,
        method=method,
    )


def test_hidden_zero_offsets_are_found_and_corrected(report: VerifyReport) -> None:
    fit = report.fit
    truth = report.samples.true_offsets
    assert fit is not None
    assert truth is not None
    assert report.config is not None
    np.testing.assert_allclose(np.degrees(truth), list(HIDDEN.values()))
    assert fit.determined == fit.joints == tuple(HIDDEN)
    np.testing.assert_allclose(fit.offsets, truth, atol=np.deg2rad(0.1))
    assert (np.abs(fit.offsets - truth) < 4 * fit.sigma).all()

    # The errors show the offsets, and that the fit removes them.
    assert not report.passed(5e-3)
    assert report.passed(5e-3, corrected=True)
    assert summary(report.judged(corrected=False)).rms_m > 5e-3
    assert summary(report.judged(corrected=True)).rms_m < 1e-3
    assert report.better
    assert not report.samples.by_arm
    assert report.excluded == ()

    # With the new zeros the servos' registers mean the true joint angles, to a tick.
    corrected = zeros_moved(report.config, report.offsets())
    assert isinstance(corrected, ArmConfig)
    moved = []
    for old, new in zip(report.config.joints, corrected.joints, strict=True):
        ticks = old.nearest_ticks(0.3)
        moved.append(new.value(ticks) - old.value(ticks))
    np.testing.assert_allclose(moved, truth, atol=np.deg2rad(0.15))


def test_a_pose_measured_with_the_arm_does_not_judge_the_arm(
    report: VerifyReport, tmp_path: Path
) -> None:
    place = extrinsics_of(report, method="handeye, eye to hand")
    place.save(tmp_path / "place.toml")
    judged = run_verify(
        VerifyRequest(
            "tabletop_puma",
            bus="sim",
            views=5,
            fit=True,
            seed=3,
            extrinsics=tmp_path / "place.toml",
        )
    )
    assert judged.samples.by_arm
    assert judged.fit is not None
    assert "joint1" in {combination.joint for combination in judged.fit.unobservable}
    assert "joint1" not in judged.offsets()
    assert judged.passed(2e-3)
    other = replace(place, intrinsics_hash="0" * 12)
    other.save(tmp_path / "other.toml")
    with pytest.raises(CalibrationError, match="another calibration"):
        run_verify(VerifyRequest("tabletop_puma", views=4, extrinsics=tmp_path / "other.toml"))


def test_a_real_camera_with_its_pose_and_a_board(
    report: VerifyReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    setups: list[Any] = []
    prepare = verify.prepare_robot

    def prepare_once(request: VerifyRequest) -> Any:
        setups.append(prepare(request))
        return setups[0]

    def open_drawn_camera(name: str, **rest: Any) -> DrawnCamera:
        setup = setups[0]
        scene = camera_and_board.scene_for(setup.robot, setup.frame)
        return DrawnCamera(scene.synthetic(setup.robot), setup.true_q)

    monkeypatch.setattr(verify, "prepare_robot", prepare_once)
    monkeypatch.setattr(vision, "open_source", open_drawn_camera)
    lens = tmp_path / "camera.yaml"
    place = tmp_path / "place.toml"
    STANDARD_CAMERA.save(lens)
    extrinsics_of(report).save(place)
    scene = camera_and_board.scene_for(report.robot, "gripper")
    judged = run_verify(
        VerifyRequest(
            "tabletop_puma",
            camera="0",
            intrinsics=lens,
            extrinsics=place,
            views=4,
            frame=scene.cube_frame,
            board=MarkerTarget(dict(scene.cube), scene.dictionary),
            pose_other_board=scene.cube_offset,
        )
    )
    assert judged.samples.true_offsets is None
    assert not judged.samples.by_arm
    assert judged.samples.frame == scene.cube_frame
    assert len(judged.samples) == len(judged.errors) == 4
    assert judged.passed(2e-3)


def test_a_dry_run_moves_nothing_and_only_locates_the_camera(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(stations, "execute", None)
    planned = run_verify(VerifyRequest("tabletop_puma", views=4, dry_run=True))
    assert len(planned.stations) == 4
    assert planned.errors == ()
    assert planned.fit is None
    monkeypatch.setattr(DrawnCamera, "hidden", (7,))
    with pytest.raises(MarkerNotFoundError, match="marker on the table is hidden"):
        run_verify(VerifyRequest("tabletop_puma", views=4, dry_run=True))


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"camera": "0"}, CalibrationError, "camera locate"),
        (
            {"camera": "0", "rehearsal": Rehearsal({"joint1": 1.0})},
            ConfigError,
            "synthetic camera only",
        ),
        ({"rehearsal": Rehearsal({"joint9": 1.0})}, UnknownJointError, "joint9"),
        ({"extrinsics": Path("nowhere.toml")}, CalibrationError, "nowhere.toml"),
    ],
)
def test_missing_input_is_reported_before_anything_moves(
    changes: dict[str, Any], error: type[Exception], text: str
) -> None:
    with pytest.raises(error) as reported:
        run_verify(VerifyRequest("tabletop_puma", **changes))
    assert text in str(reported.value)


def test_statistics_are_over_halves_of_the_space() -> None:
    errors = []
    for x, distance in ((0.1, 1e-3), (0.2, 2e-3), (0.5, 4e-3)):
        position = np.array([x, 0.0, 0.0])
        vector = np.array([0.0, distance, 0.0])
        errors.append(PoseError(position, vector, 0.01, 1e-4, 1e-3, False))
    whole, near, far = regions(errors)
    assert (whole.name, whole.poses, near.poses, far.poses) == ("all", 3, 2, 1)
    assert whole.rms_m == pytest.approx(np.sqrt(7e-6))
    assert whole.median_m == 2e-3
    assert whole.largest_m == 4e-3
    assert near.name == "x < 300 mm"
    assert near.largest_m == 2e-3
    assert far.rms_m == pytest.approx(4e-3)


def test_the_picture_shows_the_errors_before_and_after_the_fit(report: VerifyReport) -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    def height(report: VerifyReport) -> int:
        png = error_picture(report.error_maps())
        image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return int(image.shape[0])

    assert height(report) > 1.8 * height(replace(report, fit=None))
    axes = Figure().subplots()
    _, scale = draw_arrows(axes, report.errors, 0, 2)
    tips = 1e3 * np.array([error.position + scale * error.vector for error in report.errors])
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    assert left < tips[:, 0].min() < tips[:, 0].max() < right
    assert bottom < tips[:, 2].min() < tips[:, 2].max() < top


def test_the_benchmark_detects_wrong_offsets(
    report: VerifyReport, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arm, "run_verify", lambda request: report)
    rows = {row.quantity: row for row in arm.joint_zero_offsets(Effort(quick=True))}
    assert len(rows) == 2
    assert rows["zero offsets, worst joint off by"].passed
    assert report.samples.true_offsets is not None
    offsets = report.samples.true_offsets + 0.01
    wrong = replace(report, samples=replace(report.samples, true_offsets=offsets))
    monkeypatch.setattr(arm, "run_verify", lambda request: wrong)
    worse = list(arm.joint_zero_offsets(Effort(quick=True)))
    assert [row.passed for row in worse] == [False, None]
