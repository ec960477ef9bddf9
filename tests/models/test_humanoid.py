"""The humanoid against its sources: P11's parts, lengths, masses, joint ranges, frames."""

import tomllib
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

import robot_ik as rik
from tests.models.arm_checks import extent

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[2] / "models" / "humanoid"
STATURE = 1.75
MASS = 73.0
SIDES = ("left", "right")
# Fractions of stature, Drillis & Contini 1966 as drawn by Winter. Not read from the XML.
HEIGHT = {"ankle": 0.039, "knee": 0.285, "hip": 0.530, "shoulder": 0.818, "eye": 0.936}
LENGTH = {"upper_arm": 0.186, "forearm": 0.146, "thigh": 0.245, "shank": 0.246}
FOOT_LENGTH = 0.152
# Dempster, in the table of Winter: share of the mass, centre of mass from the proximal joint, and
# radius of gyration.
LIMB = {
    "upper_arm": (0.028, 0.436, 0.322),
    "forearm": (0.016, 0.430, 0.303),
    "thigh": (0.100, 0.433, 0.323),
    "shank": (0.0465, 0.433, 0.302),
}
OTHER_MASS = {"hand": 0.006}
FOOT_MASS = 0.0145
FOOT_GYRATION = 0.475  # foot and toes
TOES = ("left_toe_pitch", "right_toe_pitch")
TRUNK_MASS = {"head": 0.081, "abdomen": 0.139, "pelvis": 0.142}
THORAX = 0.216  # torso and both shoulder girdles
# Degrees: AAOS 1965; girdle Levangie & Norkin; loaded ankle and adduction of the arm: README.
SIDED_RANGE = {
    "clavicle_yaw": (-25, 20),
    "clavicle_roll": (-10, 45),
    "shoulder_pitch": (-60, 180),
    "shoulder_roll": (-40, 180),
    "shoulder_yaw": (-90, 70),
    "elbow_pitch": (0, 150),
    "wrist_pitch": (-30, 20),
    "wrist_yaw": (-70, 80),
    "hip_pitch": (-30, 120),
    "hip_roll": (-30, 45),
    "hip_yaw": (-45, 45),
    "knee_pitch": (0, 135),
    "ankle_pitch": (-50, 35),
    "ankle_yaw": (-15, 35),
    "toe_pitch": (-30, 70),
}
MIDDLE_RANGE = {
    "head_yaw": (-60, 60),
    "head_pitch": (-45, 45),
    "torso_pitch": (-12.5, 40),
    "torso_yaw": (-45, 45),
    "pelvis_pitch": (-12.5, 40),
    "pelvis_roll": (-35, 35),
}
RANGE = MIDDLE_RANGE | {
    f"{side}_{name}": span for side in SIDES for name, span in SIDED_RANGE.items()
}


@cache
def load() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(FOLDER / "humanoid.xml"))


@cache
def reported() -> dict[str, Any]:
    return tomllib.loads((FOLDER / "robot.toml").read_text())


def posed(joints: dict[str, float] | None = None) -> mujoco.MjData:
    data = mujoco.MjData(load())
    for name, value in (joints or {}).items():
        data.joint(name).qpos[0] = value
    mujoco.mj_forward(load(), data)
    return data


def test_nine_parts_have_the_degrees_of_freedom_of_arkineman() -> None:
    """Torso, head, shoulders and pelvis have two joints each, limbs 3 + 1 + 2. The torso floats."""
    parts = list(reported()["groups"].items())[:9]
    freedoms = {name: len([joint for joint in joints if joint != "root"]) for name, joints in parts}
    one_segment = ("torso", "head", "pelvis", "left_shoulder", "right_shoulder")
    limbs = ("left_arm", "right_arm", "left_leg", "right_leg")
    assert freedoms == dict.fromkeys(one_segment, 2) | dict.fromkeys(limbs, 6)
    assert sorted(joint for _, joints in parts for joint in joints) == sorted(
        {"root", *RANGE} - {*TOES}
    )
    model = load()
    assert model.nv == 6 + 5 * 2 + 4 * 6 + len(TOES)
    assert model.joint("root").type[0] == mujoco.mjtJoint.mjJNT_FREE
    assert model.jnt_bodyid[model.joint("root").id] == model.body("torso").id
    for limb, joints in parts:
        if limb in limbs:
            bodies = [int(model.jnt_bodyid[model.joint(joint).id]) for joint in joints]
            assert [bodies.count(body) for body in dict.fromkeys(bodies)] == [3, 1, 2], limb
            assert [joint.rsplit("_", 1)[1] for joint in joints[3:]] == ["pitch", "pitch", "yaw"]


def test_lengths_are_those_of_the_table() -> None:
    data = posed()
    heights = {
        "ankle": "foot",
        "knee": "shank",
        "hip": "thigh",
        "shoulder": "upper_arm",
    }
    for side, sign in (("left", 1), ("right", -1)):
        for joint, body in heights.items():
            assert data.body(f"{side}_{body}").xpos[2] == pytest.approx(
                HEIGHT[joint] * STATURE, abs=1e-12
            )
        for upper, lower in zip(LENGTH, ("forearm", "hand", "shank", "foot"), strict=True):
            gap = data.body(f"{side}_{upper}").xpos - data.body(f"{side}_{lower}").xpos
            assert gap == pytest.approx([0, 0, LENGTH[upper] * STATURE], abs=1e-12), upper
        foot = data.site(f"{side}_toe").xpos - data.site(f"{side}_heel").xpos
        assert foot == pytest.approx([FOOT_LENGTH * STATURE, 0, 0], abs=1e-12)
        assert data.body(f"{side}_upper_arm").xpos[1] == pytest.approx(sign * 0.110 * STATURE)
        assert data.body(f"{side}_thigh").xpos[1] == pytest.approx(sign * 0.049 * STATURE)
    assert data.site("gaze").xpos[2] == pytest.approx(HEIGHT["eye"] * STATURE, abs=1e-12)
    spans = [extent(load(), data, geom) for geom in range(load().ngeom)]
    assert min(bottom for bottom, _ in spans) == pytest.approx(0, abs=1e-12)
    assert max(top for _, top in spans) == pytest.approx(STATURE, abs=1e-5)


def test_masses_are_those_of_the_table() -> None:
    model = load()
    assert model.body_mass.sum() == pytest.approx(MASS, abs=1e-9)
    for side in SIDES:
        for name, (share, centre, gyration) in LIMB.items():
            body = model.body(f"{side}_{name}")
            length = LENGTH[name] * STATURE
            assert body.mass[0] == pytest.approx(share * MASS)
            assert body.ipos == pytest.approx([0, 0, -centre * length], abs=1e-5)
            assert body.inertia[:2] == pytest.approx(
                [share * MASS * (gyration * length) ** 2] * 2, rel=5e-3
            )
        for name, share in OTHER_MASS.items():
            assert model.body(f"{side}_{name}").mass[0] == pytest.approx(share * MASS)
        foot = model.body(f"{side}_foot")
        toes = model.body(f"{side}_toes")
        assert foot.mass[0] + toes.mass[0] == pytest.approx(FOOT_MASS * MASS)
    for name, share in TRUNK_MASS.items():
        assert model.body(name).mass[0] == pytest.approx(share * MASS)
    thorax = sum(model.body(name).mass[0] for name in ("torso", "left_shoulder", "right_shoulder"))
    assert thorax == pytest.approx(THORAX * MASS)
    inertia = model.body_inertia[1:]
    assert np.all(inertia > 0) and np.all(inertia.sum(axis=1) >= 2 * inertia.max(axis=1))


def test_foot_and_toes_together_are_the_foot_of_the_table() -> None:
    """Centre of mass half way along the foot, and the table's radius of gyration across it."""
    model = load()
    data = posed()
    whole = FOOT_MASS * MASS
    parts = [model.body(f"left_{part}").id for part in ("foot", "toes")]
    centre = sum(model.body_mass[b] * data.xipos[b] for b in parts) / whole
    middle = (data.site("left_heel").xpos[0] + data.site("left_toe").xpos[0]) / 2
    assert centre[0] - data.site("left_foot").xpos[0] == pytest.approx(0.0675, abs=1e-6)
    assert centre[0] == pytest.approx(middle, abs=0.006)
    across = 0.0
    for b in parts:
        axes = data.ximat[b].reshape(3, 3)
        across += (axes @ np.diag(model.body_inertia[b]) @ axes.T)[2, 2]
        across += model.body_mass[b] * float(((data.xipos[b] - centre)[:2] ** 2).sum())
    assert across == pytest.approx(0.00484, rel=1e-4)
    assert (across / whole) ** 0.5 / (FOOT_LENGTH * STATURE) < FOOT_GYRATION


def test_joint_speed_limits_cover_every_hinge_in_both_sets() -> None:
    speeds = rik.load_robot("humanoid").file.speeds
    assert set(speeds) == {"daily", "jump"}
    for name, rows in speeds.items():
        assert all(speed > 0.0 for speed in rows.values()), name
        for joint in RANGE:
            assert any(fnmatch(joint, pattern) for pattern in rows), (name, joint)


def test_the_centre_of_mass_is_that_of_a_man() -> None:
    """Standing men have it at 55 to 58 % of their stature, over the feet."""
    data = posed()
    assert 0.55 < data.subtree_com[0][2] / STATURE < 0.58
    assert abs(data.subtree_com[0][1]) < 1e-12


def test_joint_ranges_are_those_of_the_table() -> None:
    model = load()
    hinges = [model.joint(j).name for j in range(model.njnt) if model.jnt_limited[j]]
    assert sorted(hinges) == sorted(RANGE)
    for name, span in RANGE.items():
        assert np.degrees(model.joint(name).range) == pytest.approx(span), name


@pytest.mark.parametrize(
    ("joint", "site", "axis", "sign"),
    [
        ("shoulder_pitch", "hand", 0, 1),
        ("shoulder_roll", "hand", 1, 1),
        ("elbow_pitch", "hand", 0, 1),
        ("wrist_pitch", "hand", 0, 1),
        ("wrist_yaw", "hand", 1, -1),
        ("clavicle_yaw", "hand", 0, 1),
        ("clavicle_roll", "hand", 2, 1),
        ("hip_pitch", "toe", 0, 1),
        ("hip_roll", "toe", 1, 1),
        ("hip_yaw", "toe", 1, -1),
        ("knee_pitch", "toe", 0, -1),
        ("ankle_pitch", "toe", 2, 1),
        ("ankle_yaw", "toe", 1, -1),
        ("toe_pitch", "toe", 2, 1),
    ],
)
@pytest.mark.parametrize("side", SIDES)
def test_positive_is_flexion_abduction_inward(
    side: str, joint: str, site: str, axis: int, sign: int
) -> None:
    """Check the direction in which a positive angle moves hand or toe; y is outwards."""
    moved = (
        posed({f"{side}_{joint}": 0.1}).site(f"{side}_{site}").xpos
        - posed().site(f"{side}_{site}").xpos
    )
    outwards = np.array([1, 1 if side == "left" else -1, 1])
    assert (moved * outwards)[axis] * sign > 1e-3


def test_bending_and_nodding_forward_are_positive() -> None:
    model = load()
    for joint in (
        "torso_pitch",
        "pelvis_pitch",
    ):  # the torso is the root: bending brings the feet forward
        assert posed({joint: 0.1}).site("left_toe").xpos[0] > posed().site("left_toe").xpos[0]
    assert posed({"head_pitch": 0.1}).site("gaze").xpos[2] < posed().site("gaze").xpos[2]
    assert model.joint("head_pitch").range[1] > 0


def test_frames_have_the_positions_of_the_readme() -> None:
    data = posed()
    robot = rik.load_robot("humanoid")
    home = mujoco.MjData(load())
    mujoco.mj_resetDataKeyframe(load(), home, load().key("home").id)
    mujoco.mj_forward(load(), home)
    for name in reported()["tools"]:
        assert data.site(name).xmat == pytest.approx(np.eye(3).ravel(), abs=1e-15), name
    hips = [data.body(f"{side}_thigh").xpos for side in SIDES]
    assert data.site("pelvis").xpos == pytest.approx((hips[0] + hips[1]) / 2)
    vision = [data.geom(f"{side}_eye").xpos for side in SIDES]
    assert data.site("gaze").xpos[1:] == pytest.approx(((vision[0] + vision[1]) / 2)[1:])
    assert 0 < data.site("gaze").xpos[0] - vision[0][0] < 0.015
    assert data.site("head").xpos == pytest.approx(data.xipos[load().body("head").id])
    for side in SIDES:
        foot = data.site(f"{side}_foot").xpos
        assert foot == pytest.approx(data.body(f"{side}_foot").xpos * [1, 1, 0], abs=1e-12)
        hand = data.site(f"{side}_hand").xpos
        palm = data.geom(f"{side}_palm").xpos
        assert np.linalg.norm(hand - palm) < 0.04
        assert data.site(f"{side}_heel").xpos[0] < foot[0] < data.site(f"{side}_toe").xpos[0]
    for name in reported()["tools"]:
        pose = robot.forward(robot.home, name)
        assert pose.position == pytest.approx(home.site(name).xpos, abs=1e-12)
    assert robot.tool == "right_hand" and "arm" not in reported()["groups"]
    assert robot.joints[0] == "root" and len(robot.joints) == 37


def test_shapes_are_mirrored_and_touch_where_bodies_would() -> None:
    model = load()
    data = posed()
    for k in range(model.ngeom):
        name = model.geom(k).name
        if name.startswith("left_"):
            image = data.geom("right" + name.removeprefix("left")).xpos
            assert data.geom(name).xpos * [1, -1, 1] == pytest.approx(image, abs=1e-12), name
            assert model.geom(name).size == pytest.approx(
                model.geom("right" + name.removeprefix("left")).size
            )
    assert data.ncon == 0
    assert posed({"left_shoulder_roll": -0.3, "left_elbow_pitch": 0.2}).ncon > 0


def test_readme_and_robot_toml_name_existing_parts() -> None:
    model = load()
    text = (FOLDER / "README.md").read_text()
    names = {model.joint(j).name for j in range(model.njnt)}
    assert all(joint in names for joints in reported()["groups"].values() for joint in joints)
    assert all(model.site(tool["site"]).id >= 0 for tool in reported()["tools"].values())
    assert reported()["home"] == "home" and reported()["provenance"]["sources"]
    for source in (
        "Pađen",
        "Drillis",
        "Winter",
        "Dempster",
        "AAOS",
        "Boone",
        "Inman",
        "Levangie",
        "Bell",
    ):
        assert source in text, source
