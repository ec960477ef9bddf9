"""The check of an arm by a camera, through the simulated arm: errors, hidden zeros found, reports."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.camera import arm
from benchmarks.camera.rows import Effort
from robot_ik.camera.calibration.extrinsics import CameraExtrinsics
from robot_ik.camera.calibration.kinematic import PoseError
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.camera import SyntheticScene
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.camera.targets import MarkerTarget
from robot_ik.errors import CalibrationError, ConfigError, MarkerNotFoundError, UnknownJointError
from robot_ik.hardware.calibration_file import zeros_moved
from robot_ik.hardware.config import ArmConfig
from robot_ik.jobs import vision
from robot_ik.jobs.arm_camera import handeye, verify
from robot_ik.jobs.arm_camera.verify import (
    VerifyReport,
    VerifyRequest,
    _draw,
    error_picture,
    regions,
    run_verify,
    summary,
)
from robot_ik.jobs.robot_setup import Rehearsal

HIDDEN = {"joint1": 2.0, "joint2": -2.5, "joint3": 1.5, "joint4": -3.0, "joint5": 2.0, "joint6": 1.0}


class Drawn(FrameSource):
    """A light camera: the markers of the scene where the servos' shafts put them, before a wall."""

    live = True
    blind: tuple[int, ...] = ()

    def __init__(self, scene: SyntheticScene, true_q: Any, *, seed: int = 0, **rest: Any) -> None:
        self.scene, self.true_q, self.size = scene, true_q, scene.intrinsics.size
        self.rng = np.random.default_rng(seed)

    def read(self) -> Frame:
        q, scene = self.true_q(), self.scene
        to_camera = scene.pose_world_camera.inverse()
        seen = {m.id: (m.size, to_camera.compose(m.pose_world(scene, q, 0.0))) for m in scene.markers}
        facing = {
            id: (size, pose)
            for id, (size, pose) in sorted(seen.items(), key=lambda one: -one[1][1].position[2])
            if pose.rotation[:, 2] @ pose.position < 0 < pose.position[2] and id not in self.blind
        }
        image = render_markers(
            scene.intrinsics, facing, self.rng, dictionary=scene.markers[0].dictionary, margin=0.15
        )
        return Frame(np.repeat(image[:, :, None], 3, axis=2), 0.0, 0)


@pytest.fixture(autouse=True, scope="module")
def _drawn() -> Iterator[None]:
    """Small pictures that are quickly made."""
    with pytest.MonkeyPatch.context() as patch:
        _draw_lightly(patch)
        yield


def _draw_lightly(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (handeye, verify):
        scene_for = module.scene_for  # type: ignore[attr-defined]
        monkeypatch.setattr(
            module, "scene_for", lambda *of, make=scene_for: replace(make(*of), intrinsics=STANDARD_CAMERA)
        )
    monkeypatch.setattr(handeye, "SyntheticSource", Drawn)


@pytest.fixture(scope="module")
def report(_drawn: None) -> VerifyReport:
    """Hidden zeros, found; made once."""
    return run_verify(VerifyRequest("tabletop_puma", views=7, fit=True, seed=3, rehearsal=Rehearsal(HIDDEN)))


def test_hidden_zeros_are_found_and_corrected(report: VerifyReport) -> None:
    fit, truth = report.fit, report.samples.true_offsets
    assert fit is not None and truth is not None and report.config is not None
    np.testing.assert_allclose(np.degrees(truth), list(HIDDEN.values()))
    assert fit.found == fit.joints == tuple(HIDDEN)
    np.testing.assert_allclose(fit.offsets, truth, atol=np.deg2rad(0.1))
    assert (np.abs(fit.offsets - truth) < 4 * fit.sigma).all()
    # The error map shows what is wrong, and that it is gone.
    assert not report.passed(5e-3) and report.passed(5e-3, corrected=True)
    assert summary(report.judged(corrected=False)).rms_m > 5e-3
    assert summary(report.judged(corrected=True)).rms_m < 1e-3
    assert report.better and not report.samples.by_arm and report.unsure == ()
    # With the new zeros the servos' registers mean the joints' true angles, to a tick.
    now = zeros_moved(report.config, report.offsets())
    said = np.array([joint.value(joint.nearest_ticks(0.3)) for joint in report.config.joints])
    ticks = [joint.nearest_ticks(0.3) for joint in report.config.joints]
    corrected = np.array([joint.value(t) for joint, t in zip(now.joints, ticks, strict=True)])
    np.testing.assert_allclose(corrected - said, truth, atol=np.deg2rad(0.15))
    assert isinstance(now, ArmConfig)


def test_a_place_that_the_arm_found_does_not_judge_it(report: VerifyReport, tmp_path: Path) -> None:
    place = CameraExtrinsics(
        report.samples.camera.pose, "world", report.samples.camera.covariance, 0.1, 0.1, "2026-01-01",
        STANDARD_CAMERA.digest, method="handeye, eye to hand",
    )  # fmt: skip
    place.save(tmp_path / "place.toml")
    found = run_verify(
        VerifyRequest(
            "tabletop_puma", bus="sim", views=5, fit=True, seed=3, extrinsics=tmp_path / "place.toml"
        )
    )
    assert found.samples.by_arm and found.fit is not None
    assert "joint1" in {one.joint for one in found.fit.unobservable} and "joint1" not in found.offsets()
    assert found.passed(2e-3)
    other = replace(place, intrinsics_hash="0" * 12)
    other.save(tmp_path / "other.toml")
    with pytest.raises(CalibrationError, match="another calibration"):
        run_verify(VerifyRequest("tabletop_puma", views=4, extrinsics=tmp_path / "other.toml"))


def test_a_camera_of_ones_own_with_its_place_and_a_board(
    report: VerifyReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []
    prepare = verify.prepare_robot
    monkeypatch.setattr(verify, "prepare_robot", lambda request: made.append(prepare(request)) or made[0])

    def opened(name: str, **rest: Any) -> Drawn:
        setup = made[0]
        return Drawn(handeye.scene_for(setup.robot, setup.frame).synthetic(setup.robot), setup.true_q)

    monkeypatch.setattr(vision, "open_source", opened)
    lens, place = tmp_path / "camera.yaml", tmp_path / "place.toml"
    STANDARD_CAMERA.save(lens)
    CameraExtrinsics(
        report.samples.camera.pose,
        "world",
        report.samples.camera.covariance,
        0.1,
        0.1,
        "2026-01-01",
        STANDARD_CAMERA.digest,
    ).save(place)
    scene = handeye.scene_for(report.robot, "gripper")
    found = run_verify(
        VerifyRequest(
            "tabletop_puma", camera="0", intrinsics=lens, extrinsics=place, views=4, frame=scene.cube_frame,
            board=MarkerTarget(dict(scene.cube), scene.dictionary), pose_other_board=scene.cube_offset,
        )
    )  # fmt: skip
    assert (
        found.samples.true_offsets is None
        and not found.samples.by_arm
        and found.samples.frame == scene.cube_frame
    )
    assert len(found.samples) == len(found.errors) == 4 and found.passed(2e-3)


def test_a_dry_run_moves_nothing_and_looks_only_for_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(handeye, "execute", None)
    found = run_verify(VerifyRequest("tabletop_puma", views=4, dry_run=True))
    assert len(found.stations) == 4 and found.errors == () and found.fit is None
    monkeypatch.setattr(Drawn, "blind", (7,))
    with pytest.raises(MarkerNotFoundError, match="marker on the table is hidden"):
        run_verify(VerifyRequest("tabletop_puma", views=4, dry_run=True))


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"camera": "0"}, CalibrationError, "camera locate"),
        ({"camera": "0", "rehearsal": Rehearsal({"joint1": 1.0})}, ConfigError, "synthetic camera only"),
        ({"rehearsal": Rehearsal({"joint9": 1.0})}, UnknownJointError, "joint9"),
        ({"extrinsics": Path("nowhere.toml")}, CalibrationError, "nowhere.toml"),
    ],
)
def test_what_is_missing_is_reported_before_anything_moves(
    changes: dict[str, Any], error: type[Exception], text: str
) -> None:
    with pytest.raises(error) as reported:
        run_verify(VerifyRequest("tabletop_puma", **changes))
    assert text in str(reported.value)


def test_sums_are_over_halves_of_the_space() -> None:
    errors = [
        PoseError(np.array([x, 0.0, 0.0]), np.array([0.0, off, 0.0]), 0.01, 1e-4, 1e-3, False)
        for x, off in ((0.1, 1e-3), (0.2, 2e-3), (0.5, 4e-3))
    ]
    whole, near, far = regions(errors)
    assert (whole.name, whole.poses, near.poses, far.poses) == ("all", 3, 2, 1)
    assert whole.rms_m == pytest.approx(np.sqrt(7e-6)) and whole.median_m == 2e-3 and whole.largest_m == 4e-3
    assert near.name == "x < 300 mm" and near.largest_m == 2e-3 and far.rms_m == pytest.approx(4e-3)


def test_the_picture_shows_the_arm_as_it_is_and_corrected(report: VerifyReport) -> None:
    pytest.importorskip("matplotlib")
    import cv2

    both = cv2.imdecode(np.frombuffer(error_picture(report), np.uint8), cv2.IMREAD_COLOR)
    one = cv2.imdecode(np.frombuffer(error_picture(replace(report, fit=None)), np.uint8), cv2.IMREAD_COLOR)
    assert both is not None and one is not None and both.shape[0] > 1.8 * one.shape[0]
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    _, scale = _draw(axes, report.errors, 0, 2)
    tips = 1e3 * np.array([one.position + scale * one.vector for one in report.errors])
    (low, high), (down, up) = axes.get_xlim(), axes.get_ylim()
    assert low < tips[:, 0].min() < tips[:, 0].max() < high
    assert down < tips[:, 2].min() < tips[:, 2].max() < up


def test_the_benchmark_sees_offsets_that_are_wrong(
    report: VerifyReport, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arm, "run_verify", lambda request: report)
    found = {one.quantity: one for one in arm.joint_zero_offsets(Effort(quick=True))}
    assert len(found) == 2 and found["zero offsets, worst joint off by"].passed
    assert report.samples.true_offsets is not None
    offsets = report.samples.true_offsets + 0.01
    wrong = replace(report, samples=replace(report.samples, true_offsets=offsets))
    monkeypatch.setattr(arm, "run_verify", lambda request: wrong)
    worse = list(arm.joint_zero_offsets(Effort(quick=True)))
    assert [one.passed for one in worse] == [False, None]
