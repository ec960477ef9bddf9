"""URDF files, prepared for MuJoCo, and the models of the package robot_descriptions."""

from __future__ import annotations

import importlib
import logging
import math
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

from robot_ik.errors import MissingExtraError, ModelError, UnknownRobotError, did_you_mean

logger = logging.getLogger(__name__)

MESH_SUFFIXES = (".stl", ".obj", ".msh")
"""Mesh formats that MuJoCo reads (XML reference, asset/mesh)."""

LIMITED_TYPES = ("revolute", "prismatic")
"""Types of joints that have limits."""

MIMIC_TYPES = (*LIMITED_TYPES, "continuous")
"""Types of joints that can mimic a joint or be mimicked: their value is one number."""

MESHES_SHOWN = 3
"""Names of missing meshes in a log message."""

LONGEST_REASON = 200
"""Characters of the reason of git in a message."""

Problem = tuple[str, str]
"""What is wrong with a file, and what to try."""


def _child(parent: ElementTree.Element, tag: str) -> ElementTree.Element:
    """Return the first child with a tag. It is added if there is none."""
    element = parent.find(tag)
    return ElementTree.SubElement(parent, tag) if element is None else element


def _limits(joint: ElementTree.Element) -> tuple[float, float] | None:
    """Return the limits of a joint, with 0 for a missing one.

    None means that both are missing, or that one is not a number, which MuJoCo reports.
    """
    limit = joint.find("limit")
    if limit is None or ("lower" not in limit.attrib and "upper" not in limit.attrib):
        return None
    try:
        return float(limit.get("lower", "0")), float(limit.get("upper", "0"))
    except ValueError:
        return None


class Urdf:
    """A URDF: its element ``robot``, and the folder to which its file names are relative.

    Attributes:
        missing_meshes: Mesh files that ``text`` has left out, by their names in the URDF.
    """

    def __init__(self, root: ElementTree.Element, folder: Path) -> None:
        self._root = root
        self._folder = folder
        self.missing_meshes: tuple[str, ...] = ()

    @classmethod
    def of_text(cls, text: str, folder: Path = Path()) -> Urdf | None:
        """Return the URDF in a text, None if the text is something else.

        Args:
            text: The text.
            folder: The folder to which its file names are relative.
        """
        try:
            root = ElementTree.fromstring(text)
        except (ElementTree.ParseError, ValueError):  # MuJoCo reports the error
            return None
        return cls(root, folder) if root.tag == "robot" else None

    @property
    def problem(self) -> Problem:
        """An error that MuJoCo does not report, or not in the terms of URDF; empty without one."""
        texts = [
            text
            for element in self._root.iter()
            for text in (element.tag, *element.attrib.values())
        ]
        if any("xacro}" in text or "${" in text or "$(" in text for text in texts):
            return "it is a xacro file, not a URDF", "xacro arm.urdf.xacro > arm.urdf"
        names = [joint.get("name", "") for joint in self._joints()]
        repeated = next((name for name in names if names.count(name) > 1), None)
        if repeated is not None:
            return f"two joints are called {repeated!r}", "give each joint another name"
        return self._equal_limits() or self._wrong_mimic() or ("", "")

    def _joints(self) -> list[ElementTree.Element]:
        return self._root.findall("joint")

    def _equal_limits(self) -> Problem | None:
        """Find a joint with two equal limits. MuJoCo takes 0 … 0 for no limits."""
        for joint in self._joints():
            limits = _limits(joint)
            if joint.get("type") in LIMITED_TYPES and limits and limits[0] == limits[1]:
                problem = (
                    f"joint {joint.get('name', '')!r} has the limits {limits[0]:g} … "
                    f"{limits[1]:g}, so it cannot move"
                )
                hint = (
                    'write its range, or type="fixed" to hold it still; '
                    'a revolute joint without limits has type="continuous"'
                )
                return problem, hint
        return None

    def _wrong_mimic(self) -> Problem | None:
        """Find a joint with a mimic that MuJoCo would ignore, so the joint would move freely."""
        types = {joint.get("name", ""): joint.get("type", "") for joint in self._joints()}
        possible = [name for name, kind in types.items() if kind in MIMIC_TYPES]
        for joint in self._joints():
            mimic = joint.find("mimic")
            name = joint.get("name", "")
            if mimic is None or types[name] == "fixed":
                continue
            leader = mimic.get("joint", "")
            impossible = [other for other in (leader, name) if other not in possible]
            if leader == name:
                reason = "which is itself"
            elif leader not in types:
                reason = "which does not exist"
            elif impossible:
                reason = f"but {impossible[0]!r} is {types[impossible[0]]}"
            else:
                continue
            others = [other for other in possible if other != name]
            known = f"it may mimic one of: {', '.join(others) or 'none'}"
            hint = did_you_mean(leader, others) or known
            return f"joint {name!r} mimics {leader!r}, {reason}", hint
        return None

    @property
    def velocity_limits(self) -> dict[str, float]:
        """Speed limits of joints, rad/s or m/s, if the file has them."""
        limits = {}
        for joint in self._root.iter("joint"):
            limit = joint.find("limit")
            try:
                velocity = float(limit.get("velocity", "0")) if limit is not None else 0.0
            except ValueError:
                velocity = 0.0  # MuJoCo does not read this attribute, so it is not an error
            if 0.0 < velocity < math.inf:
                limits[joint.get("name", "")] = velocity
        return limits

    def text(self) -> str:
        """Return the text that MuJoCo reads.

        Fixed joints keep their frames, and meshes are found, unless the ``<mujoco>`` element of the
        file has other settings. Missing meshes, and meshes in a format that MuJoCo does not read
        (.dae), are left out, because kinematics needs no meshes.
        """
        for joint in self._joints():
            limit = joint.find("limit")
            is_limited = joint.get("type") in LIMITED_TYPES and _limits(joint) is not None
            if limit is not None and is_limited:
                limit.attrib.setdefault("lower", "0")  # MuJoCo ignores a single limit
                limit.attrib.setdefault("upper", "0")
        compiler = _child(_child(self._root, "mujoco"), "compiler")
        compiler.attrib.setdefault("fusestatic", "false")
        if "meshdir" not in compiler.attrib and "strippath" not in compiler.attrib:
            compiler.set("strippath", "false")
            self._find_meshes()
        return ElementTree.tostring(self._root, encoding="unicode")

    def _find_meshes(self) -> None:
        """Replace the names of meshes by paths, and remove the shapes of missing meshes."""
        missing = []
        for link in self._root.iter("link"):
            for shape in [*link.findall("visual"), *link.findall("collision")]:
                mesh = shape.find("geometry/mesh")
                if mesh is None:
                    continue
                name = mesh.get("filename", "")
                path = self._file(name)
                if path is None or path.suffix.lower() not in MESH_SUFFIXES:
                    missing.append(name)
                    link.remove(shape)
                else:
                    mesh.set("filename", str(path))
        self.missing_meshes = tuple(dict.fromkeys(missing))
        if missing:
            names = ", ".join(missing[:MESHES_SHOWN])
            logger.warning(
                "meshes left out, because they are missing or neither STL nor OBJ: %d (%s%s)",
                len(missing),
                names,
                ", …" if len(missing) > MESHES_SHOWN else "",
            )

    def _file(self, name: str) -> Path | None:
        """Return the existing file of a mesh name, None if there is none."""
        return next((path for path in self._candidates(name) if path.is_file()), None)

    def _candidates(self, name: str) -> Iterator[Path]:
        """Yield the files that ``package://PACKAGE/…``, ``file://…`` or a plain name can mean."""
        folder = self._folder.resolve()
        if not name.startswith("package://"):
            path = Path(name.removeprefix("file://"))
            yield folder / path
            yield folder / path.name
            return
        package, _, rest = name.removeprefix("package://").partition("/")
        for parent in (folder, *folder.parents):
            yield parent / package / rest
            if parent.name == package:
                yield parent / rest


def described_model(name: str) -> Path:
    """Return the model file of a description in the package robot_descriptions: MJCF, else URDF.

    The package downloads it with git if it is not in its cache.

    Raises:
        MissingExtraError: The package is not installed.
        UnknownRobotError: The package has no such description. The message has close names.
        ModelError: git could not download it.
    """
    try:
        from robot_descriptions import DESCRIPTIONS  # an optional dependency
    except ImportError as error:
        purpose = f"the robot {name!r}"
        raise MissingExtraError("robot_descriptions", "descriptions", purpose) from error
    if name not in DESCRIPTIONS:
        hint = "all names: python -m robot_descriptions list"
        raise UnknownRobotError(name, DESCRIPTIONS, hint=hint)
    try:
        module = importlib.import_module(f"robot_descriptions.{name}")
    except Exception as error:  # git raises errors of many classes
        folder = os.environ.get("ROBOT_DESCRIPTIONS_CACHE", "~/.cache/robot_descriptions")
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        reason = lines[-1] if lines else ""
        raise ModelError(
            f"the description {name!r} is not in {folder}, and git could not download it: "
            f"{reason[:LONGEST_REASON]}",
            reason=str(error),
            hint=f"with a network connection: python -m robot_descriptions pull {name}",
        ) from error
    return Path(getattr(module, "MJCF_PATH", None) or module.URDF_PATH)
