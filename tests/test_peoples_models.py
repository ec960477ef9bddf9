"""Models of users: nameless joints, URDFs of other programs, texts, specs, robot_descriptions."""

import logging
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import InvalidModelError, MissingExtraError, ModelError, UnknownRobotError

NAMELESS = """<mujoco model="nameless"><worldbody><body name="base" pos="0 0 1"><freejoint/>
<geom type="box" size=".1 .1 .1"/><body><joint axis="0 0 1" range="-170 170"/><geom size=".05"/>
<body pos="0 0 .3"><joint name="joint_2" axis="0 1 0" range="-120 120"/><geom size=".05"/>
<body pos="0 0 .3"><joint axis="0 1 0" range="-120 120"/><geom size=".05"/>
<site name="tip" pos="0 0 .2"/>
</body></body></body></body></worldbody></mujoco>"""

# No <inertial>, a fixed joint at the end, meshes of a package: one exists, one has another format.
URDF = """<robot name="two"><link name="base"/>
<link name="upper"><visual><geometry><mesh filename="package://two/meshes/upper.stl"/></geometry>
</visual></link>
<link name="fore"><visual><geometry><mesh filename="package://two/meshes/fore.dae"/></geometry>
</visual></link>
<link name="tool0"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
 <limit lower="-2" upper="2" velocity="0.7" effort="1"/></joint>
<joint name="bend" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 .3"/>
 <axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="1.3" effort="1"/></joint>
<joint name="end" type="fixed"><parent link="fore"/><child link="tool0"/><origin xyz="0 0 .25"/>
</joint>
</robot>"""
INERTIAL = (
    '<inertial><mass value="1"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
)
TRIANGLES = """solid s
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
facet normal 0 1 0
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 0 1
endloop
endfacet
facet normal 1 0 0
outer loop
vertex 0 0 0
vertex 0 1 0
vertex 0 0 1
endloop
endfacet
facet normal 1 1 1
outer loop
vertex 1 0 0
vertex 0 1 0
vertex 0 0 1
endloop
endfacet
endsolid s
"""


@pytest.fixture
def nameless(tmp_path: Path) -> Path:
    path = tmp_path / "nameless.xml"
    path.write_text(NAMELESS)
    return path


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    """The file of a ROS package: urdf/ and meshes/ side by side."""
    folder = tmp_path / "two"
    (folder / "meshes").mkdir(parents=True)
    (folder / "urdf").mkdir()
    (folder / "meshes" / "upper.stl").write_text(TRIANGLES)
    path = folder / "urdf" / "two.urdf"
    path.write_text(URDF)
    return path


def test_joints_without_names_get_a_name_in_the_mujoco_model(nameless: Path) -> None:
    robot = rik.load_robot(nameless)
    assert robot.joints == ("joint_0", "joint_1", "joint_2", "joint_3")
    assert [robot.model.joint(name).id for name in robot.joints] == [0, 1, 2, 3]
    assert rik.load_robot(nameless, joints=["joint_3"]).joints == ("joint_3",)
    taken = NAMELESS.replace('name="joint_2"', 'name="joint_1"')
    assert rik.load_robot(taken).joints == ("joint_0", "joint_1_", "joint_1", "joint_3")


def test_a_urdf_keeps_its_fixed_frames_and_speed_limits_and_needs_no_inertia(
    urdf: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        robot = rik.load_robot(urdf)
    assert robot.tool == "tool0" and {"base", "upper", "fore"} <= set(robot.frames)
    assert robot.velocity_limits.tolist() == [0.7, 1.3]
    np.testing.assert_allclose(robot.forward([0.0, np.pi / 2]).position, [0.25, 0, 0.3], atol=1e-12)
    assert (
        "meshes left out" in caplog.text and ": 1 (" in caplog.text and "fore.dae)" in caplog.text
    )
    with pytest.raises(ModelError, match="no mass"):
        rik.solve(robot, rik.CenterOfMassGoal(position=[0.1, 0.0, 0.3]))


def test_a_urdf_that_asks_for_it_is_fused() -> None:
    asks = URDF.replace("<link", '<mujoco><compiler fusestatic="true"/></mujoco><link', 1)
    for mesh in ("upper.stl", "fore.dae"):
        asks = asks.replace(
            f'<visual><geometry><mesh filename="package://two/meshes/{mesh}"/></geometry></visual>',
            INERTIAL,
        )
    assert "tool0" not in rik.load_robot(asks).frames


def test_text_and_spec_are_robots(nameless: Path) -> None:
    spec = mujoco.MjSpec.from_string(NAMELESS)
    whole = rik.load_robot(nameless)
    for robot in (rik.load_robot(NAMELESS), rik.load_robot(spec), rik.load_robot("\n " + NAMELESS)):
        assert robot.name == "nameless" and robot.joints == whole.joints and robot.arm_file is None
        assert robot.forward(robot.home).distance(whole.forward(whole.home)) == (0.0, 0.0)
    assert spec.joints[0].name == ""  # the spec is not changed
    with pytest.raises(ModelError, match="not a model that MuJoCo can read"):
        rik.load_robot("<mujoco><worldbody>")


def test_radians_read_as_degrees_get_a_hint(caplog: pytest.LogCaptureFixture) -> None:
    arm = (
        '<mujoco>{}<worldbody><body name="a">'
        '<joint axis="0 0 1" range="-3.1 3.1"/><geom size=".1"/>'
    )
    arm += "</body></worldbody></mujoco>"
    rik.load_robot(arm.format('<compiler angle="radian"/>'))
    rik.load_robot(arm.format("").replace("3.1", "31"))
    assert not caplog.records
    rik.load_robot(arm.format(""))
    assert 'angle="radian"' in caplog.text and "3.10 degrees" in caplog.text


def test_warnings_of_mujoco_about_masses_are_logged_and_not_printed(
    caplog: pytest.LogCaptureFixture, recwarn: pytest.WarningsRecorder
) -> None:
    twice = '<joint name="j1"/><joint name="j2"/>'  # one axis: kinematics only
    with caplog.at_level(logging.INFO):
        robot = rik.load_robot(
            f'<mujoco><worldbody><body name="a">{twice}<geom size="0.1"/></body>'
            "</worldbody></mujoco>"
        )
    assert robot.nq == 2 and not recwarn.list
    (record,) = caplog.records
    assert record.levelno == logging.INFO and "nertia" in record.getMessage()


@pytest.mark.parametrize("where", ['pos="nan 0 0"', 'quat="1 nan 0 0"'])
def test_a_number_that_is_not_finite_is_named(where: str) -> None:
    text = (
        f'<mujoco><worldbody><body name="a" {where}><joint/><geom size=".1"/></body>'
        "</worldbody></mujoco>"
    )
    with pytest.raises(ModelError, match=r"'a'.*not finite|MuJoCo can read"):
        rik.load_robot(text)


@pytest.mark.parametrize("value", [5, None, 2.5, b"puma560", ["puma560"]])
def test_a_value_that_is_not_a_name_is_a_value_error(value: object) -> None:
    with pytest.raises(
        InvalidModelError,
        match="is not a robot\na robot is a name of the catalogue, the path or text of",
    ) as caught:
        rik.load_robot(value)  # type: ignore[arg-type]
    assert isinstance(caught.value, ValueError) and repr(value) in str(caught.value)


def test_a_missing_file_is_not_taken_for_an_unknown_name(nameless: Path) -> None:
    with pytest.raises(
        ModelError, match=r"there is no file .*namless\.xml\ndid you mean .*nameless\.xml"
    ):
        rik.load_robot(nameless.with_name("namless.xml"))
    with pytest.raises(ModelError, match=r"there is no file arm\.urdf"):
        rik.load_robot("arm.urdf")
    with pytest.raises(ModelError, match=r"has no robot\.toml"):
        rik.load_robot(nameless.parent)


# Robot_descriptions


def test_without_the_package_the_install_line_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    with pytest.raises(MissingExtraError, match=r'pip install "robot-ik-testbed\[descriptions\]"'):
        rik.load_robot("robot_descriptions:panda_mj_description")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of robot_descriptions, from which descriptions are loaded offline."""
    pytest.importorskip("robot_descriptions", reason="needs the extra `descriptions`")
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("ROBOT_DESCRIPTION_COMMIT", "local")
    monkeypatch.setenv("GIT_ALLOW_PROTOCOL", "file")  # git downloads nothing
    for name in ("panda_mj_description", "so_arm101_mj_description"):
        monkeypatch.delitem(sys.modules, f"robot_descriptions.{name}", raising=False)
    return tmp_path / "cache"


def test_a_description_in_the_cache_is_a_robot(cache: Path, nameless: Path) -> None:
    repository = cache / "mujoco_menagerie-local" / "mujoco_menagerie"
    model = repository / "franka_emika_panda" / "panda.xml"
    model.parent.mkdir(parents=True)
    model.write_text(NAMELESS)
    for words in (["init", "-q", "-b", "local"], ["add", "."], ["commit", "-q", "-m", "one"]):
        author = ["-c", "user.name=a", "-c", "user.email=a@b"]
        subprocess.run(["git", *author, *words], cwd=repository, check=True)
    robot = rik.load_robot("robot_descriptions:panda_mj_description")
    assert robot.name == "panda_mj_description" and robot.path == model and robot.tool == "tip"


def test_a_description_that_git_cannot_download_has_a_hint(cache: Path) -> None:
    with pytest.raises(
        ModelError, match=r"could not download it(.|\n)*pull so_arm101_mj_description"
    ) as caught:
        rik.load_robot("robot_descriptions:so_arm101_mj_description")
    assert str(cache) in str(caught.value) and len(str(caught.value)) < 600


def test_an_unknown_description_lists_close_names(cache: Path) -> None:
    with pytest.raises(UnknownRobotError, match="panda_mj_description"):
        rik.load_robot("robot_descriptions:panda_mj_descripton")


def test_parts_that_mujoco_ignores_are_logged_without_a_file(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    limited = URDF.replace('lower="-2" upper="2" velocity="0.7"', 'lower="0" upper="0"')
    rik.load_robot(limited.replace("revolute", "planar", 1))
    assert [record.levelno for record in caplog.records if "limit ignored" in record.message] == [
        logging.WARNING
    ]
    (tmp_path / "no_extension").write_text(NAMELESS)
    with pytest.raises(ModelError):
        rik.load_robot(tmp_path / "no_extension")
    assert capfd.readouterr().err == "" and [file.name for file in tmp_path.iterdir()] == [
        "no_extension"
    ]


def test_an_impossible_inertia_is_accepted() -> None:
    wrong = INERTIAL.replace('iyy="1" izz="1"', 'iyy="0.1" izz="0.1"')
    robot = rik.load_robot(URDF.replace('<link name="fore">', f'<link name="fore">{wrong}'))
    assert robot.joints == ("turn", "bend")


@pytest.mark.parametrize(
    ("was", "becomes", "message"),
    [
        ('xyz="0 0 .3"', 'xyz="0 0 ${length}"', "xacro file"),
        (
            '<robot name="two">',
            '<robot name="two" xmlns:xacro="http://ros.org/wiki/xacro"><xacro:a/>',
            "xacro file",
        ),
        ('"bend"', '"turn"', "two joints are called 'turn'"),
    ],
)
def test_an_unfinished_urdf_is_refused_with_a_reason(was: str, becomes: str, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        rik.load_robot(URDF.replace(was, becomes))
    # xacro does not remove its namespace.
    namespace = '<robot name="two" xmlns:xacro="http://ros.org/wiki/xacro">'
    assert rik.load_robot(URDF.replace('<robot name="two">', namespace)).nv == 2


@pytest.mark.parametrize("limit", ["0", "0.5"])
def test_a_urdf_joint_that_cannot_move_is_refused_and_not_unlimited(limit: str) -> None:
    still = URDF.replace('lower="-2" upper="2" velocity="1.3"', f'lower="{limit}" upper="{limit}"')
    with pytest.raises(
        ModelError, match=rf"joint 'bend' has the limits {limit} … {limit}"
    ) as caught:
        rik.load_robot(still)
    assert 'type="fixed"' in caught.value.hint and 'type="continuous"' in caught.value.hint


def test_a_urdf_with_one_limit_has_zero_for_the_other() -> None:
    robot = rik.load_robot(URDF.replace('lower="-2" upper="2" velocity="1.3"', 'lower="-2"'))
    assert (robot.lower[1], robot.upper[1]) == (-2.0, 0.0)


@pytest.mark.parametrize(
    ("leader", "message", "hint"),
    [
        ("tern", "'bend' mimics 'tern', which does not exist", "did you mean turn"),
        ("end", "'bend' mimics 'end', but 'end' is fixed", "one of: turn"),
        ("bend", "'bend' mimics 'bend', which is itself", "turn"),
    ],
)
def test_a_urdf_joint_with_an_invalid_mimic_is_refused(
    leader: str, message: str, hint: str
) -> None:
    limit = '<limit lower="-2" upper="2" velocity="1.3" effort="1"/>'
    with pytest.raises(ModelError, match=message) as caught:
        rik.load_robot(URDF.replace(limit, f'{limit}<mimic joint="{leader}"/>'))
    assert hint in caught.value.hint
    robot = rik.load_robot(URDF.replace(limit, f'{limit}<mimic joint="turn" multiplier="-1"/>'))
    assert robot.apply_couplings([0.5, 0.0]).tolist() == [0.5, -0.5]


def test_an_mjcf_with_another_suffix_is_refused_with_the_suffixes(tmp_path: Path) -> None:
    for name in ("arm.mjcf", "arm.toml", "arm"):
        path = tmp_path / name
        path.write_text(NAMELESS)
        with pytest.raises(ModelError) as caught:
            rik.load_robot(path)
        assert "ends with .xml or .urdf" in caught.value.hint


def test_a_model_in_millimetres_loads_with_its_huge_masses() -> None:
    robot = rik.load_robot(
        NAMELESS.replace('size=".1 .1 .1"', 'size="400 400 400"').replace(".3", "300")
    )
    assert robot.model.body_inertia.max() > 1e15
    goal = rik.PositionGoal("tip", robot.forward(robot.clip(robot.home + 0.2)).position)
    assert rik.solve(robot, goal, tolerance=rik.Tolerance(0.1)).converged
