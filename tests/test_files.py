"""Files of users: any content raises only errors of this package."""

from __future__ import annotations

import ast
import codecs
import contextlib
import json
import os
import re
import shutil
import sys
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import robot_ik
from robot_ik import config, load_robot
from robot_ik.camera.calibration.extrinsics import CameraExtrinsics, today
from robot_ik.camera.calibration.kinematic import KnownPose
from robot_ik.camera.drawing.occluders import load_occluders
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.target_files import load_bodies
from robot_ik.camera.targets import Observation
from robot_ik.errors import ConfigError, ModelError, RobotIkError
from robot_ik.figure.motion.bvh import Bvh, export_bvh
from robot_ik.figure.motion.retarget import SkeletonMap
from robot_ik.files import json_text, plain
from robot_ik.geometry import Pose
from robot_ik.hardware.calibration_file import Calibration, JointCalibration
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.lerobot_calibration import load_lerobot, save_lerobot
from robot_ik.hardware.virtual.faults import load_faults
from robot_ik.motion import Trajectory
from robot_ik.motion.key_poses import KeyPoses
from robot_ik.motion.keyframes import Keyframes
from robot_ik.script import load_script, shipped
from robot_ik.testbed.ar.motion import make_motion, robot_of
from robot_ik.testbed.ar.script_motion import is_script
from robot_ik.testbed.commands import CommandLog, Reset, Start
from robot_ik.testbed.gallery_scene import gallery_scene
from robot_ik.workcell.arm_camera.samples import SampleSet, VerifySamples
from robot_ik.workcell.guided_recording import load_motion

ROOT = Path(robot_ik.__file__).parent
HARDWARE = Path(str(sys.modules["robot_ik.hardware"].__file__)).parent
ROBOT = load_robot("puma560")
FIGURE = load_robot("humanoid")
assert ROBOT.arm_file is not None
ARM = ArmConfig.load(ROBOT.arm_file)
LENS = CameraIntrinsics(640, 480, 600.0, 600.0, 320.0, 240.0, (0.1, 0.0, 0.0, 0.0, 0.0))

BODIES = """[[body]]
name = "cube"
markers = [
    {id = 20, size = 0.07, position = [0, 0, 0.04], wxyz = [1, 0, 0, 0]},
    {id = 21, size = 0.07},
]
"""
FAULTS = """schema = 1
seed = 3
[[faults]]
kind = "silent"
joint = "joint2"
at_s = 1.5
[[faults]]
kind = "drop"
value = 0.01
"""
BOXES = "[[box]]\nposition = [0.1, 0.2, 0.0]\nsize = [0.1, 0.1, 0.1]\nyaw_deg = 30\n"
MJCF = """<mujoco><worldbody><body name="one" pos="0 0 1">
<joint name="a" axis="0 0 1" range="-90 90"/>
<geom size="0.1" mass="1"/><site name="tip" pos="0.1 0 0" quat="1 0 0 0"/></body></worldbody>
<keyframe><key name="home" qpos="0.5"/></keyframe></mujoco>
"""
URDF = """<robot name="r"><link name="base"/><link name="arm"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="a" type="revolute">
<parent link="base"/><child link="arm"/><origin xyz="0 0 1" rpy="0 0 0"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>
"""


# Files that are read


# Limits that are not in LeRobot's file.
NO_LIMITS = defaultdict(lambda: (0.0, 0.0))


def _calibration() -> Calibration:
    rows = tuple(
        JointCalibration(j.name, j.servo.id, j.servo.model, 0, 0, 100, 3000, 1, 2048, -90.0, 90.0)
        for j in ARM.joints
    )
    return Calibration(ARM.name, ARM.robot, today(), rows)


def _samples() -> SampleSet:
    made = SampleSet("puma560", ROBOT.joints, "gripper", "eye_in_hand", LENS)
    points = [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.1, 0.1, 0.0), (0.0, 0.1, 0.0)]
    for _ in range(2):
        made.add(
            ROBOT.home,
            Observation(points, [(1, 2), (30, 4), (5, 60), (7, 8)], Pose((0, 0, 1)), 0.1),
        )
    return made


def _verify() -> VerifySamples:
    known = KnownPose.within(Pose(), 1e-3, 1e-3)
    rows = tuple(plain(joint) for joint in ARM.joints)
    made = VerifySamples(
        "puma560",
        ROBOT.joints,
        "gripper",
        "eye_in_hand",
        LENS,
        camera=known,
        board=known,
        by_arm=False,
        true_offsets=np.zeros(ROBOT.nv),
        servos=rows,
    )
    for q, view in zip(_samples().q, _samples().views, strict=True):
        made.add(q, view)
    return made


def _motion() -> Trajectory:
    return Trajectory([0.0, 0.1, 0.2], np.tile(ROBOT.home, (3, 1)), ROBOT.joints)


def _frames() -> Keyframes:
    return Keyframes(ROBOT, [0.0, 0.1, 0.2], np.tile(ROBOT.home, (3, 1)))


def _robot_folder(path: Path) -> object:
    """Read ``path`` as the robot.toml beside a model."""
    folder = path.with_suffix(".robot")
    if not folder.exists():
        shutil.copytree(Path(str(ROBOT.path)).parent, folder)
    shutil.copyfile(path, folder / "robot.toml")
    return gallery_scene(load_robot(folder))


def _saved(save: Callable[[Path], object]) -> Callable[[Path], str]:
    def text(folder: Path) -> str:
        save(folder / "saved")
        return (folder / "saved").read_text(encoding="utf-8")

    return text


@dataclass(frozen=True)
class Row:
    """A reader, the name of its file, and the content of a valid file."""

    read: Callable[[Path], object]
    name: str
    text: Callable[[Path], str]

    @property
    def language(self) -> str:
        return self.name.rpartition(".")[2]


def _csv_motion(path: Path) -> object:
    drawn: Any = None  # a motion from a file needs no figure
    with contextlib.ExitStack() as stack:
        make_motion(str(path), ROBOT, drawn, stack)
    return load_motion(path, ROBOT.joints)


ROWS = {
    "arm file": Row(ArmConfig.load, "arm.toml", lambda _: ARM.to_toml()),
    "calibration": Row(Calibration.load, "c.toml", _saved(_calibration().save)),
    "LeRobot's": Row(
        lambda p: load_lerobot(p, ARM, NO_LIMITS),
        "l.json",
        _saved(lambda p: save_lerobot(p, _calibration())),
    ),
    "faults": Row(lambda p: load_faults(p, ARM), "f.toml", lambda _: FAULTS),
    "script": Row(
        load_script, "s.toml", lambda _: shipped()["take_a_block"].read_text(encoding="utf-8")
    ),
    "motion of ar": Row(
        lambda p: (is_script(str(p)), robot_of(str(p))),
        "m.toml",
        lambda _: shipped()["out_of_reach"].read_text(encoding="utf-8"),
    ),
    "place": Row(
        CameraExtrinsics.load,
        "p.toml",
        _saved(CameraExtrinsics(Pose(), "world", np.eye(6), 0.1, 0.2, today(), LENS.digest).save),
    ),
    "bodies": Row(load_bodies, "bodies.toml", lambda _: BODIES),
    "boxes": Row(load_occluders, "boxes.toml", lambda _: BOXES),
    "things as a model": Row(load_occluders, "things.xml", lambda _: MJCF),
    "MJCF": Row(load_robot, "m.xml", lambda _: MJCF),
    "URDF": Row(load_robot, "u.xml", lambda _: URDF),
    "intrinsics": Row(CameraIntrinsics.load, "camera.yaml", _saved(LENS.save)),
    "robot.toml": Row(
        _robot_folder,
        "r.toml",
        lambda _: (Path(str(ROBOT.path)).parent / "robot.toml").read_text("utf-8"),
    ),
    "samples": Row(lambda p: SampleSet.load(p).samples(ROBOT), "h.json", _saved(_samples().save)),
    "verify": Row(
        lambda p: VerifySamples.load(p).arm(ROBOT.arm_file), "v.json", _saved(_verify().save)
    ),  # type: ignore[arg-type]
    "motion": Row(_csv_motion, "t.csv", _saved(_motion().save_csv)),
    "key poses": Row(
        lambda p: KeyPoses.load(p, FIGURE),
        "k.toml",
        lambda _: (FIGURE.folder / "poses.toml").read_text("utf-8"),
    ),
    "names of joints": Row(
        SkeletonMap.load, "n.toml", lambda _: (FIGURE.folder / "bvh.toml").read_text("utf-8")
    ),
    "frames": Row(lambda p: Keyframes.load_csv(p, ROBOT), "frames.csv", _saved(_frames().save_csv)),
    "motion capture": Row(Bvh.load, "m.bvh", _saved(export_bvh(_frames(), 30.0).save)),
    "command log": Row(
        CommandLog.load, "log.jsonl", lambda _: CommandLog(Start("puma560"), ((3, Reset()),)).text()
    ),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("files")


# Search for all readers

READING = {name for name in vars(config) if re.match(r"(read|parse)(_|$)", name)} | {"read_model"}

FOREIGN = {
    "tomllib.loads",
    "tomllib.load",
    "json.loads",
    "json.load",
    "yaml.load",
    "yaml.safe_load",
    "csv.reader",
    "csv.DictReader",
    "ElementTree.parse",
    "ElementTree.fromstring",
    "ElementTree.iterparse",
    "pickle.load",
    "np.load",
    "np.loadtxt",
    "np.genfromtxt",
    "from_xml_path",
    "from_xml_string",
    "read_text",
    "read_bytes",
    "model_validate_json",
    "FileStorage",
    "from_file",
    "open",
}

ALLOWED = {
    ("robot_ik/config.py", "*"): "the functions that read files",
    ("robot_ik/model.py", "from_file"): "read_model, which checks the numbers of the model",
    ("robot_ik/urdf.py", "ElementTree.fromstring"): "a text that read_model has read",
    ("robot_ik/camera/calibration_file.py", "yaml.load"): "called by parse",
    (
        "hardware/virtual/world.py",
        "from_file",
    ): "the model of a robot that load_robot has just read",
    (
        "hardware/stop_file.py",
        "json.loads",
    ): "between processes of this program, in a folder of mode 0700",
    ("hardware/stop_file.py", "read_text"): "likewise",
    ("hardware/checks.py", "read_text"): "/proc",
    (
        "robot_ik/commands/doctor_checks.py",
        "read_text",
    ): "the metadata of an installed distribution",
    ("robot_ik/testbed/frontends/site.py", "read_bytes"): "bundled files of the page",
    ("robot_ik/testbed/frontends/browser.py", "read_text"): "a file that it has just written",
    ("robot_ik/testbed/filming.py", "read_bytes"): "a film that it has just written",
    ("robot_ik/kernels/jit.py", "read_bytes"): "its own sources",
    ("robot_ik/motion/recording.py", "open"): "only written",
    ("hardware/ports.py", "read_text"): "/sys",
    ("robot_ik/camera/device.py", "read_text"): "/sys",
    ("robot_ik/bench/methods/results.py", "read_text"): "/proc",
    (
        "robot_ik/figure/reach_map.py",
        "np.load",
    ): "a map of this program, without pickle; any error computes it again",
    (
        "robot_ik/figure/reach_map.py",
        "read_bytes",
    ): "for a digest of the model that load_robot has just read",
    ("robot_ik/commands/figure_recording.py", "read_bytes"): "likewise",
    (
        "robot_ik/testbed/frontends/session_window.py",
        "from_file",
    ): "the model of a robot that load_robot has just read",
    (
        "robot_ik/testbed/frontends/session_window.py",
        "read_text",
    ): "the text of a robot that load_robot has just read",
    ("robot_ik/pose_prior.py", "np.load"): "without pickle; a broken file is a ConfigError",
    ("robot_ik/commands/streams.py", "open"): "/dev/null",
    ("robot_ik/testbed/frontends/window_scene.py", "read_text"): "the scene of a bundled robot",
    ("robot_ik/commands/robots.py", "ElementTree.parse"): "bundled models",
    ("robot_ik/workcell/arm_camera/samples.py", "json.loads"): "a file that it has just written",
    ("hardware/calibration_file.py", "read_bytes"): "an arm file that ArmConfig.load has just read",
}
"""Calls (file, call) that read without ``robot_ik.config``, with the reason."""

INTERNAL_READERS = {
    "requested": "from robot-ik stop; any error stops the arm",
}


@cache
def _sources() -> list[tuple[str, ast.Module]]:
    return [
        (
            f"{prefix}/{file.relative_to(top).as_posix()}",
            ast.parse(file.read_text(encoding="utf-8")),
        )
        for top, prefix in ((ROOT, "robot_ik"), (HARDWARE, "hardware"))
        for file in sorted(top.rglob("*.py"))
    ]


def _calls(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield the name of every called function, and the name with its owner."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            called = node.func
            if isinstance(called, ast.Name):
                yield called.id, called.id
            elif isinstance(called, ast.Attribute):
                owner = called.value.id if isinstance(called.value, ast.Name) else ""
                yield called.attr, f"{owner}.{called.attr}"


def _readers() -> set[str]:
    """Functions that read a file through ``robot_ik.config``."""
    found = set()
    for name, tree in _sources():
        if name == "robot_ik/config.py":
            continue
        imported = {
            alias.name
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            and node.module in ("robot_ik.config", "robot_ik.model")
            for alias in node.names
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and node.name not in INTERNAL_READERS:
                inner = {word for word, full in _calls(node) if full == word}
                if inner & READING & imported:
                    found.add(f"{name}:{node.name}")
    return found


def test_all_files_are_read_by_the_functions_of_config() -> None:
    found = set()
    for name, tree in _sources():
        for word, full in _calls(tree):
            call = full if full in FOREIGN else word
            is_open = call == "open" and full != "open"  # opens of buses, ports and cameras
            if call in FOREIGN and not is_open and (word != "read_text" or full != word):
                found.add((name, call))
    assert ("robot_ik/model.py", "from_file") in found
    new = {item for item in found if item not in ALLOWED and (item[0], "*") not in ALLOWED}
    assert not new, "read files with robot_ik.config, or add the reason to ALLOWED"


def test_every_reader_has_a_row_in_this_file(folder: Path) -> None:
    ran = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            ran.add((frame.f_code.co_filename, frame.f_code.co_name))

    for row in ROWS.values():
        path = folder / row.name
        path.write_text(row.text(folder), encoding="utf-8")
        sys.setprofile(note)
        try:
            row.read(path)  # a valid file is read
        finally:
            sys.setprofile(None)
    places = {"robot_ik": ROOT, "hardware": HARDWARE}
    missing = []
    for reader in _readers():
        file, _, name = reader.partition(":")
        top, _, rest = file.partition("/")
        if (str(places[top] / rest), name) not in ran:
            missing.append(reader)
    assert not missing, "a reader without a row in ROWS"


# Hostile files


@dataclass(frozen=True)
class Raw:
    """Text that is written to a file unchanged."""

    text: str


def _word(value: str) -> str:
    return json.dumps(value)


def _dump(value: Any, language: str) -> str:
    """Return a value in a language, on one line."""
    if isinstance(value, Raw):
        return value.text
    if isinstance(value, dict):
        equals = " = " if language == "toml" else ": "
        return (
            "{"
            + ", ".join(f"{_word(str(k))}{equals}{_dump(v, language)}" for k, v in value.items())
            + "}"
        )
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_dump(v, language) for v in value) + "]"
    return (
        _word(value) if isinstance(value, (str, bool, int, float)) or value is None else str(value)
    )


def _file_text(content: dict[str, Any], language: str) -> str:
    if language == "toml":
        return "".join(f"{_word(k)} = {_dump(v, language)}\n" for k, v in content.items())
    return _dump(content, language)


@cache
def _content(text: str, language: str) -> Any:
    """Return the content of a text. The result is shared, so ``_changed`` copies it."""
    if language == "yaml":
        return {
            "image_width": 640,
            "image_height": 480,
            "camera_name": "c",
            "distortion_model": "plumb_bob",
            "camera_matrix": {
                "rows": 3,
                "cols": 3,
                "data": [600.0, 0.0, 320.0, 0.0, 600.0, 240.0, 0, 0, 1],
            },
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.1, 0.0, 0.0, 0.0, 0.0]},
            "avg_reprojection_error": 0.3,
            "views": 12,
        }
    return tomllib.loads(text) if language == "toml" else json.loads(text)


def _places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if path:
        yield path
    items = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, item in items:
        yield from _places(item, (*path, key))


def _changed(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    """Return a copy with another value at a path; ``...`` removes the value."""
    if not path:
        return new
    if isinstance(value, dict):
        changed = {k: _changed(v, path[1:], new) if k == path[0] else v for k, v in value.items()}
        return {k: v for k, v in changed.items() if v is not ...}
    changed_list = [_changed(v, path[1:], new) if k == path[0] else v for k, v in enumerate(value)]
    return [v for v in changed_list if v is not ...]


NESTED = "[" * 1000 + "]" * 1000
DIGITS = "7" * 4400
HOSTILE: list[Any] = [
    Raw(NESTED),
    Raw("[" * 40 + "1" + "]" * 40),
    Raw(DIGITS),
    Raw("-" + DIGITS),
    Raw("9" * 400),
    Raw("1e308"),
    Raw("-1e308"),
    Raw("1e999"),
    Raw("5e-324"),
    2**63,
    2**31,
    -1,
    0,
    0.0,
    1,
    0.5,
    1e14,
    -1e14,
    True,
    False,
    "",
    "x",
    "\x00",
    "nan",
    "x" * 3000,
    "Ü" * 200,
    [],
    {},
    [[]],
    [1, 2],
    [0.0] * 3,
    [0.0] * 4,
    ["a", "b"],
    {"a": 1},
    [{}],
    [True],
    [None],
    None,
    ...,
]
NAN = {"json": "NaN", "toml": "nan", "yaml": ".nan"}
TREES = [name for name, row in ROWS.items() if row.language in NAN]
TEXTS = [name for name, row in ROWS.items() if row.language not in NAN]


@cache
def _good(name: str, folder: Path) -> str:
    return ROWS[name].text(folder)


def _survives(row: Row, folder: Path, text: str | bytes) -> RobotIkError | None:
    """Return the error of this package that reading a file raises, or None."""
    path = folder / row.name
    path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass"))
    try:
        row.read(path)
    except RobotIkError as error:
        assert len(str(error)) < 1500, "the message is too long"
        str(error).encode("utf-8")
        return error
    return None


COMMON = settings(
    max_examples=100 if os.environ.get("ROBOT_IK_EXAMPLES") == "explore" else 15,  # for each row
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@pytest.mark.parametrize("name", TREES)
@COMMON
@given(data=st.data())
def test_only_errors_of_this_package_leave_a_reader(
    name: str, folder: Path, data: st.DataObject
) -> None:
    row = ROWS[name]
    content = _content(_good(name, folder), row.language)
    for _ in range(data.draw(st.integers(1, 2))):
        place = data.draw(st.sampled_from(list(_places(content))))
        new = data.draw(st.sampled_from([*HOSTILE, Raw(NAN[row.language])]))
        content = _changed(content, place, new)
        if not isinstance(content, dict) or isinstance(new, Raw):
            break
    _survives(row, folder, _file_text(content, row.language))


@pytest.mark.parametrize("name", ROWS)
@COMMON
@given(data=st.data())
def test_damaged_text_raises_only_errors_of_this_package(
    name: str, folder: Path, data: st.DataObject
) -> None:
    text = _good(name, folder).encode()
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(text)))
        new = data.draw(
            st.sampled_from(
                [b"", b"\xff", b"\x00", b'"', b"[", b"{", b"}", b"\n", b"=", b",", b"-"]
            )
        )
        text = text[:at] + new + text[at + data.draw(st.sampled_from([0, 1, 7, 300])) :]
    _survives(ROWS[name], folder, text)


@pytest.mark.parametrize("name", TEXTS)
@COMMON
@given(data=st.data())
def test_hostile_words_in_models_and_tables_raise_only_errors_of_this_package(
    name: str, folder: Path, data: st.DataObject
) -> None:
    text = _good(name, folder)
    words = list(re.finditer(r"(?<=[\"\s,])[-\w.]+(?=[\"\s,])", text))
    word = data.draw(st.sampled_from(words))
    new = data.draw(
        st.sampled_from(
            [
                "nan",
                "inf",
                "1e308",
                "-1e308",
                "5e-324",
                "9" * 4400,
                "",
                "x",
                "-1",
                "0",
                "1e14",
                "1,2",
            ]
        )
    )
    _survives(ROWS[name], folder, text[: word.start()] + new + text[word.end() :])


@pytest.mark.parametrize(
    "hostile", [NESTED, DIGITS, "1e308", "1e999", "nan"], ids=lambda text: text[:6]
)
@pytest.mark.parametrize("name", TREES)
def test_the_file_and_the_key_are_named(name: str, folder: Path, hostile: str) -> None:
    row = ROWS[name]
    content = _content(_good(name, folder), row.language)

    def at(path: tuple[Any, ...]) -> Any:
        value = content
        for part in path:
            value = value[part]
        return value

    numbers = [path for path in _places(content) if type(at(path)) in (int, float)]
    key = [part for part in numbers[-1] if isinstance(part, str)][-1]
    raw = Raw(NAN[row.language] if hostile == "nan" else hostile)
    error = _survives(row, folder, _file_text(_changed(content, numbers[-1], raw), row.language))
    assert error is not None
    file = "robot.toml" if name == "robot.toml" else row.name
    assert file in str(error)
    if hostile not in (NESTED, DIGITS):  # the parser refuses these itself
        assert key in str(error).partition("\n")[0], error


@pytest.mark.parametrize("name", ROWS)
def test_a_missing_file_is_named(name: str, folder: Path) -> None:
    row = ROWS[name]
    for text in (b"", b"\xff\xfe\x00x", b"\x00" * 100, b"[" * 100_000, b'{"a":' * 100_000):
        error = _survives(row, folder, text)
        assert error is not None
    if name != "robot.toml":
        with pytest.raises(RobotIkError, match=r"none\."):
            row.read(folder / f"none.{row.language}")


def test_a_file_without_end_is_refused() -> None:
    with pytest.raises(ConfigError, match="more than 256 MiB"):
        config.read_text(Path("/dev/zero"), "the arm file")


def test_a_model_file_that_is_too_large_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(config, "LARGEST_FILE", 2**20)
    for name, text in (("large.xml", MJCF), ("large.urdf", URDF)):
        (folder / name).write_text(text + " " * 2**20, encoding="utf-8")
        with pytest.raises(
            ModelError, match=rf"{name}: the model cannot be read: it has more than 1 MiB"
        ):
            load_robot(folder / name)


def test_a_very_deeply_nested_urdf_is_refused() -> None:
    with pytest.raises(ModelError, match="not a model that MuJoCo can read"):
        load_robot('<robot name="r">' + "<a>" * 100_000 + "</a>" * 100_000 + "</robot>")


def test_aliases_of_yaml_do_not_multiply(folder: Path) -> None:
    lines = ["a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    for one, other in zip("abcdefg", "bcdefgh", strict=True):
        lines.append(f"{other}: &{other} [{', '.join([f'*{one}'] * 9)}]")
    text = "\n".join([*lines, "image_width: 640", "image_height: 480", "camera_matrix: *h"])
    error = _survives(ROWS["intrinsics"], folder, text)
    assert error is not None and "aliases" in str(error)
    error = _survives(ROWS["intrinsics"], folder, "image_width: &a [*a]\n")
    assert error is not None and "aliases" in str(error)


@pytest.mark.parametrize("text", ['{"\\ud800": 1}', '{"\\ud800": {}}', '{"a": "\\udc00"}'])
def test_a_lone_surrogate_is_refused_with_a_printable_message(text: str) -> None:
    with pytest.raises(ConfigError, match="surrogates not allowed") as caught:
        config.parse_json(text, "x.json")
    str(caught.value).encode("utf-8")


def test_booleans_and_text_are_not_accepted_as_numbers(folder: Path) -> None:
    file = folder / "strict.toml"
    for name, old, new in (
        ("arm file", "baud = 1000000", "baud = true"),
        ("arm file", "direction = 1", "direction = true"),
        ("script", "mass_g = 50.0", "mass_g = true"),
        ("faults", "at_s = 1.5", 'at_s = "1.5"'),
        ("bodies", "id = 20", "id = true"),
        ("boxes", "yaw_deg = 30", "yaw_deg = false"),
        ("robot.toml", "schema = 1", "schema = true"),
    ):
        text = ROWS[name].text(folder)
        assert old in text, name
        file.write_text(text.replace(old, new, 1))
        with pytest.raises(ConfigError, match=old.partition(" ")[0]):
            ROWS[name].read(file)


def test_a_byte_order_mark_is_removed(folder: Path) -> None:
    path = folder / "from_windows.toml"
    path.write_bytes(codecs.BOM_UTF8 + b"key = 1\r\n")
    assert config.read_toml(path, "the file") == {"key": 1}


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner) | st.tuples(inner),
    max_leaves=20,
)


@given(JSON_VALUES)
def test_plain_gives_json_that_every_reader_accepts(value: object) -> None:
    simple = plain(value)
    assert json.loads(json.dumps(simple, allow_nan=False)) == simple
    assert json.loads(json_text(simple)) == simple


def test_plain_takes_arrays_and_keeps_every_digit() -> None:
    q = np.array([0.1, np.pi, -1e-17])
    assert np.array_equal(plain({"q": q})["q"], q)
    assert plain(np.float64("nan")) is None
    assert plain(np.array([np.inf, 1.0])) == [None, 1.0]
    assert plain(np.int64(3)) == 3
