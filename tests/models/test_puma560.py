"""The PUMA 560 against its sources: DH product, limits, masses, frames, robot and servo files."""

import math
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.models.arm_checks import posed, site

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[2] / "models" / "puma560"
JOINTS = tuple(f"joint{i}" for i in range(1, 7))
LIMIT_DEG = np.array(
    [160.0, 110.0, 135.0, 266.0, 100.0, 266.0]
)  # Robotics Toolbox, as in the benchmark
# a, alpha / 90 deg, d of the Toolbox's standard DH table; typed again here, the XML is not read.
DH = (
    (0.0, 1, 26.45 * 0.0254),
    (0.4318, 0, 0.0),
    (0.0203, -1, 0.15005),
    (0.0, 1, 0.4318),
    (0.0, -1, 0.0),
    (0.0, 0, 0.0),
)


def dh_flange(q: Array) -> Array:
    """DH frame 6 seen from the floor, (4, 4), as Rz(q) Tz(d) Tx(a) Rx(alpha) products."""
    pose = np.eye(4)
    for angle, (a, quarter, d) in zip(q, DH, strict=True):
        c = math.cos(angle)
        s = math.sin(angle)
        ca, sa = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter % 4]
        pose = pose @ np.array(
            [
                [c, -s * ca, s * sa, a * c],
                [s, c * ca, -c * sa, a * s],
                [0, sa, ca, d],
                [0, 0, 0, 1.0],
            ]
        )
    return pose


@cache
def load(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(FOLDER / name))


@cache
def settings(name: str) -> dict[str, Any]:
    return tomllib.loads((FOLDER / name).read_text())


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return load("puma560.xml")


angles = st.tuples(*(st.floats(-v, v) for v in np.radians(LIMIT_DEG))).map(np.array)


@given(q=angles)
def test_flange_is_dh_frame_6(q: Array) -> None:
    position, rotation = site(posed(load("puma560.xml"), q), "flange")
    expected = dh_flange(q)
    assert np.abs(position - expected[:3, 3]).max() < 1e-12
    assert np.abs(rotation - expected[:3, :3]).max() < 1e-12


def test_known_pose_of_the_zero_configuration(model: mujoco.MjModel) -> None:
    position, rotation = site(posed(model, np.zeros(6)), "flange")
    assert position == pytest.approx([0.4318 + 0.0203, -0.15005, 0.67183 + 0.4318], abs=1e-15)
    assert rotation == pytest.approx(np.eye(3), abs=1e-15)


def test_joints_and_limits_equal_the_source(model: mujoco.MjModel) -> None:
    assert tuple(model.joint(i).name for i in range(model.njnt)) == JOINTS
    assert np.all(model.jnt_limited == 1)
    assert np.abs(model.jnt_range - np.radians(LIMIT_DEG)[:, None] * [-1.0, 1.0]).max() < 1e-15


def test_masses_and_inertias_are_those_of_a_rigid_body(model: mujoco.MjModel) -> None:
    mass = {model.body(i).name: model.body_mass[i] for i in range(model.nbody)}
    literature = {"link2": 17.4, "link3": 4.8, "link4": 0.82, "link5": 0.34, "link6": 0.09}
    assert {name: mass[name] for name in literature} == pytest.approx(literature)
    assert sum(mass.values()) == pytest.approx(17.4 + 4.8 + 0.82 + 0.34 + 0.09 + 13.0 + 0.6)
    moving = [i for i in range(model.nbody) if model.body(i).name not in ("world", "base")]
    inertia = model.body_inertia[moving]
    assert np.all(inertia > 0)
    assert np.all(inertia.sum(axis=1) >= 2 * inertia.max(axis=1))
    dense = np.zeros((6, 6))
    data = posed(model, np.zeros(6))
    mujoco.mj_fullM(model, data, dense)
    assert np.linalg.eigvalsh(dense).min() > 0.1


def test_link_3_inertia_is_within_5_percent_of_the_measured_one(model: mujoco.MjModel) -> None:
    data = posed(model, np.zeros(6))
    axes = data.body("link3").ximat.reshape(3, 3)
    inertia = np.diag(axes @ np.diag(model.body("link3").inertia) @ axes.T)
    assert inertia == pytest.approx([0.066, 0.086, 0.0125], rel=0.05)


def test_gripper_frames_are_rigid_to_the_flange(model: mujoco.MjModel) -> None:
    data = posed(model, np.array([0.3, 1.2, -0.4, 2.0, 0.7, -1.1]))
    origin, rotation = site(data, "flange")
    for name, offset in {"gripper": 0.185, "mounting_face": 0.05625, "marker_cube": 0.104}.items():
        position, axes = site(data, name)
        assert rotation.T @ (position - origin) == pytest.approx([0, 0, offset], abs=1e-14), name
        assert axes == pytest.approx(rotation, abs=1e-14), name


@pytest.mark.parametrize("number", [20, 21, 22, 23])
def test_printed_sides_of_the_cube_carry_the_markers_of_their_sites(number: int) -> None:
    """Content and rotation of the pictures. Their place was checked with MuJoCo's renderer."""
    turns = {20: 3, 21: 0, 22: 1, 23: 2}
    image = cv2.imread(str(FOLDER / "assets" / f"marker_{number}.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50)
    printed = np.pad(
        cv2.aruco.generateImageMarker(dictionary, number, 126), 21, constant_values=255
    )
    assert np.array_equal(image, np.rot90(printed, turns[number]))


def test_arm_toml_names_every_joint_and_covers_the_model(model: mujoco.MjModel) -> None:
    arm = settings("arm.toml")
    assert arm["robot"] == "puma560"
    rows = arm["joints"]
    assert tuple(row["name"] for row in rows) == JOINTS
    assert sorted(row["id"] for row in rows) == [1, 2, 3, 4, 5, 6]
    motion = settings("robot.toml")["motion"]
    for i, row in enumerate(rows):
        lower, upper = np.degrees(model.joint(row["name"]).range)
        assert lower - 1e-9 <= row["lower_deg"] < row["upper_deg"] <= upper + 1e-9
        assert row["velocity_deg"] >= motion["velocity_deg"][i]
        assert row["acceleration_deg"] >= motion["acceleration_deg"][i]
        ticks = [servo_ticks(row, row[k]) for k in ("lower_deg", "upper_deg")]
        if row["mode"] == "position":
            assert row["ratio"] == 1.0 and min(ticks) >= 0 and max(ticks) <= 4095
        for key in (
            "home",
            "ready",
        ):  # servos lose full turns at power-off, so the start is inside the first turn
            assert 256 < servo_ticks(row, math.degrees(model.key(key).qpos[i])) < 4095 - 256, (
                row,
                key,
            )


def servo_ticks(row: dict[str, Any], degrees: float) -> float:
    return float(row["zero_ticks"] + row["direction"] * row["ratio"] * degrees / 360 * 4096)


def test_readme_names_its_sources() -> None:
    text = (FOLDER / "README.md").read_text()
    for source in (
        "Corke",
        "Robotics Toolbox",
        "Armstrong, O. Khatib, J. Burdick",
        "Lee",
        "desk copy",
        "0.672",
    ):
        assert source in text
    assert settings("robot.toml")["provenance"]["sources"]
