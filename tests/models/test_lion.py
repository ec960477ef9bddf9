"""The lion: leg ranges of cats, balls along the spine, frames, poses, mirror symmetry, solves."""

import math
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import robot_ik as rik
from tests.models.arm_checks import extent

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[2] / "models" / "lion"
PAWS = tuple(f"{end}_{side}_paw" for end in ("front", "hind") for side in ("left", "right"))
KEYS = ("relaxed", "sitting")
BALL = int(mujoco.mjtJoint.mjJNT_BALL)
HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
CONE_DEG = {f"spine_{i}": 20 for i in (1, 2, 3)} | {"neck": 50, "head": 50, "tail_1": 90}
CONE_DEG |= {f"tail_{i}": 50 for i in (2, 3, 4, 5)}
# Jaeger et al. 2007, cats: angle between the bones at full flexion and full extension, degrees, and
# the three points that span it, frames or anchors by body. The hip is measured from the line of the
# pelvis.
CAT_DEG = {
    "front_left_shoulder_pitch": (32, 163, ("scapula", "upper_arm", "forearm")),
    "front_left_elbow_pitch": (22, 163, ("upper_arm", "forearm", "pastern")),
    "front_left_wrist_pitch": (22, 198, ("forearm", "pastern", "paw")),
    "hind_left_hip_pitch": (33, 164, (None, "thigh", "shank")),
    "hind_left_knee_pitch": (24, 164, ("thigh", "shank", "hind_foot")),
    "hind_left_hock_pitch": (21, 167, ("shank", "hind_foot", "paw")),
}
PELVIS_DEG = 30.0  # rise of the pelvis's line, forward from the hip, at q = 0


@cache
def load(name: str = "lion.xml") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(FOLDER / name))


@cache
def reported() -> dict[str, Any]:
    return tomllib.loads((FOLDER / "robot.toml").read_text())


@cache
def lion_robot() -> rik.Robot:
    return rik.load_robot("lion")


def posed(joints: dict[str, Array | float] | None = None, key: str | None = None) -> mujoco.MjData:
    data = mujoco.MjData(load())
    if key is not None:
        data.qpos[:] = load().key(key).qpos
    for name, value in (joints or {}).items():
        data.joint(name).qpos[:] = value
    mujoco.mj_forward(load(), data)
    return data


def test_body_plan() -> None:
    """A floating ribcage, balls along the spine, eight hinges a front leg, seven a hind leg."""
    model = load()
    kinds = {model.joint(j).name: int(model.jnt_type[j]) for j in range(model.njnt)}
    assert kinds.pop("root") == mujoco.mjtJoint.mjJNT_FREE
    assert model.jnt_bodyid[0] == model.body("chest").id
    for name, cone in CONE_DEG.items():
        assert kinds.pop(name) == BALL
        assert np.degrees(model.joint(name).range) == pytest.approx([0, cone]), name
    assert set(kinds.values()) == {HINGE} and np.all(model.jnt_limited[1:] == 1)
    for leg, count in (("front_left", 8), ("front_right", 8), ("hind_left", 7), ("hind_right", 7)):
        assert sorted(reported()["groups"][f"{leg}_leg"]) == sorted(
            n for n in kinds if n.startswith(leg)
        )
        assert len(reported()["groups"][f"{leg}_leg"]) == count
    assert model.nv == 6 + 3 * len(CONE_DEG) + 30


def included_deg(joint: str, angle: float) -> float:
    """Angle between the two bones at a joint, on the flexion side, 0…360."""
    leg = joint.rsplit("_", 2)[0]
    bones = CAT_DEG[joint][2]
    data = posed({joint: angle})
    anchor = [data.body(f"{leg}_{bone}").xpos[[0, 2]] if bone else None for bone in bones]
    here = anchor[1]
    distal = anchor[2]
    assert here is not None and distal is not None
    line = np.array([math.cos(math.radians(PELVIS_DEG)), math.sin(math.radians(PELVIS_DEG))])
    upper = line if anchor[0] is None else anchor[0] - here
    lower = distal - here
    turn = math.degrees(math.atan2(upper[0] * lower[1] - upper[1] * lower[0], upper @ lower)) % 360
    return turn if joint.rsplit("_", 2)[1] in ("shoulder", "wrist", "knee") else 360 - turn


@pytest.mark.parametrize("joint", CAT_DEG)
def test_legs_fold_and_stretch_as_a_cats(joint: str) -> None:
    flexed, extended, _ = CAT_DEG[joint]
    reached = sorted(included_deg(joint, float(limit)) for limit in load().joint(joint).range)
    assert reached == pytest.approx([flexed, extended], abs=0.6)  # ranges are whole degrees


def test_size_and_mass_of_a_grown_lion() -> None:
    model = load()
    data = posed()
    assert model.body_mass.sum() == pytest.approx(190, abs=0.5)
    withers = data.geom("withers")
    assert 0.95 < withers.xpos[2] + model.geom("withers").size[2] < 1.15
    body = data.site("nose").xpos[0] - data.body("tail_1").xpos[0]
    assert 1.6 < body < 2.1
    tail = sum(
        float(np.linalg.norm(data.body(f"tail_{i + 1}").xpos - data.body(f"tail_{i}").xpos))
        for i in range(1, 5)
    ) + float(np.linalg.norm(data.site("tail_tip").xpos - data.body("tail_5").xpos))
    assert 0.7 < tail < 1.05
    inertia = model.body_inertia[1:]
    assert np.all(inertia > 0) and np.all(
        inertia.sum(axis=1) >= 2 * inertia.max(axis=1) * (1 - 1e-9)
    )


def test_frames_have_the_positions_of_the_readme() -> None:
    data = posed()
    robot = lion_robot()
    for name in reported()["tools"]:
        assert data.site(name).xmat == pytest.approx(np.eye(3).ravel(), abs=1e-15), name
        pose = robot.forward(robot.home, name)
        assert pose.position == pytest.approx(posed(key="relaxed").site(name).xpos, abs=1e-12)
    for name in PAWS:
        place = data.site(name).xpos
        toes = [data.geom(f"{name[:-4]}_toe_{i}").xpos for i in (1, 2, 3, 4)]
        assert abs(place[2]) < 1e-12
        assert place[0] < min(toe[0] for toe in toes)
        assert place[1] == pytest.approx(np.mean([toe[1] for toe in toes]))
    assert data.site("nose").xpos[0] > max(data.geom_xpos[:, 0])
    vision = (data.geom("left_eye").xpos + data.geom("right_eye").xpos) / 2
    assert np.linalg.norm(data.site("gaze").xpos - vision) < 0.04
    assert data.site("tail_tip").xpos[0] < min(data.geom_xpos[:, 0])
    assert (
        robot.tool == "nose"
        and "arm" not in reported()["groups"]
        and len(robot.joints) == load().njnt
    )


@pytest.mark.parametrize("key", KEYS)
def test_keyframes_rest_on_flat_paws_free_and_inside_limits(key: str) -> None:
    model = load()
    data = posed(key=key)
    for name in PAWS:
        assert abs(data.site(name).xpos[2]) < 1e-9, name
        assert data.site(name).xmat[6:] == pytest.approx([0, 0, 1], abs=1e-9), name
    assert min(extent(model, data, geom)[0] for geom in range(model.ngeom)) == pytest.approx(
        0, abs=1e-9
    )
    assert data.ncon == 0
    assert lion_robot().outside(data.qpos) == []
    for actuator in range(model.nu):
        assert data.actuator_length[actuator] == pytest.approx(
            model.key(key).ctrl[actuator], abs=1e-9
        )
    paws = np.array([data.site(name).xpos for name in PAWS])
    assert paws[:, 0].min() - 0.1 < data.subtree_com[0][0] < paws[:, 0].max()


def test_keyframes_match_their_names() -> None:
    stands = posed(key="relaxed")
    sits = posed(key="sitting")
    assert reported()["home"] == "relaxed"
    rump = load().geom("rump").id
    assert extent(load(), stands, rump)[0] > 0.5
    assert extent(load(), sits, rump)[0] < 0.01
    assert sits.body("chest").xmat.reshape(3, 3)[2, 0] > math.sin(math.radians(25))
    assert sits.site("tail_tip").xpos[2] < 0.1


@st.composite
def poses(draw: st.DrawFn) -> dict[str, Array]:
    drawn: dict[str, Array] = {}
    for j in range(1, load().njnt):
        joint = load().joint(j)
        if joint.type[0] == HINGE:
            drawn[joint.name] = np.array([draw(st.floats(*map(float, joint.range)))])
        else:
            axis = np.array(
                [draw(st.floats(-1, 1)), draw(st.floats(-1, 1)), draw(st.floats(0.1, 1))]
            )
            half = draw(st.floats(0, float(joint.range[1]))) / 2
            drawn[joint.name] = np.array(
                [math.cos(half), *(math.sin(half) * axis / np.linalg.norm(axis))]
            )
    return drawn


def across(name: str) -> str:
    if "left" in name:
        return name.replace("left", "right")
    return name.replace("right", "left")


@settings(max_examples=30)
@given(pose=poses())
def test_mirrored_pose_has_mirrored_frames(pose: dict[str, Array]) -> None:
    """Hinges change sides; a ball's turn keeps its y and changes the sign of x and z."""
    model = load()
    flip = np.array([1.0, -1.0, 1.0])
    turned = {across(n): v * [1, -1, 1, -1] if len(v) == 4 else v for n, v in pose.items()}
    data = posed(dict(pose))
    image = posed(dict(turned))
    for k in range(model.nsite):
        here = data.site(k)
        there = image.site(across(data.site(k).name))
        assert np.abs(there.xpos - flip * here.xpos).max() < 1e-12
        assert (
            np.abs(there.xmat.reshape(3, 3) - np.outer(flip, flip) * here.xmat.reshape(3, 3)).max()
            < 1e-12
        )
    for k in range(1, model.nbody):
        here = data.body(k)
        there = image.body(across(data.body(k).name))
        assert np.abs(there.xpos - flip * here.xpos).max() < 1e-12


def test_shapes_are_mirrored_and_touch_where_bodies_would() -> None:
    model = load()
    data = posed()
    for k in range(model.ngeom):
        name = model.geom(k).name
        if "left" in name:
            assert data.geom(name).xpos * [1, -1, 1] == pytest.approx(
                data.geom(across(name)).xpos, abs=1e-12
            )
            assert model.geom(name).size == pytest.approx(model.geom(across(name)).size)
    assert data.ncon == 0
    assert posed({"hind_left_hip_roll": -0.26, "hind_right_hip_roll": -0.26}).ncon > 0


@pytest.mark.parametrize("paw", PAWS)
@pytest.mark.parametrize("key", KEYS)
def test_every_paw_has_six_degrees_of_freedom(key: str, paw: str) -> None:
    legs = rik.load_robot("lion", joints=f"{paw[:-4]}_leg")
    start = np.array(
        [load().key(key).qpos[load().joint(joint).qposadr[0]] for joint in legs.joints]
    )
    assert np.linalg.svd(legs.jacobian(start, paw), compute_uv=False)[5] > 0.02


def pinned(*frames: str) -> list[rik.PoseGoal]:
    robot = lion_robot()
    goals = []
    for frame in frames:
        place = robot.forward(robot.home, frame)
        goals.append(rik.PoseGoal(frame, place.position, place.wxyz))
    return goals


@pytest.mark.parametrize(
    ("frame", "place"),
    [
        ("nose", (1.0, 0.25, 0.35)),
        ("nose", (0.9, -0.3, 1.35)),
        ("front_right_paw", (0.85, -0.25, 0.75)),
        ("tail_tip", (-1.2, 0.3, 1.2)),
    ],
)
def test_the_lion_reaches_while_the_other_paws_stay(
    frame: str, place: tuple[float, float, float]
) -> None:
    robot = lion_robot()
    goals = [*pinned(*(paw for paw in PAWS if paw != frame)), rik.PositionGoal(frame, place)]
    solution = rik.solve(robot, goals, solver="lm")
    assert solution.converged and robot.outside(solution.q) == []
    for goal in goals:
        pose = robot.measure(solution.q, goal.frame)
        assert np.linalg.norm(pose.position - goal.target.position) < 1e-4
        if isinstance(goal, rik.PoseGoal):
            assert abs(pose.wxyz @ goal.target.wxyz) > math.cos(1e-3 / 2)


@pytest.mark.parametrize("key", KEYS)
def test_motors_hold_every_keyframe_on_the_floor(key: str) -> None:
    model = load("scene.xml")
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(key).id)
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert abs(data.qpos[2] - model.key(key).qpos[2]) < 0.05
    assert data.body("chest").xmat[8] > 0.5


def test_readme_and_robot_toml_name_existing_parts() -> None:
    model = load()
    text = (FOLDER / "README.md").read_text()
    names = {model.joint(j).name for j in range(model.njnt)}
    groups = reported()["groups"]
    assert all(joint in names for joints in groups.values() for joint in joints)
    assert names == {
        joint for name in ("base", "spine", "neck", "tail", "legs") for joint in groups[name]
    }
    assert all(model.site(tool["site"]).id >= 0 for tool in reported()["tools"].values())
    for source in ("Šimunić", "Jaeger", "ours"):
        assert source in text, source
