"""URDF files as people have them, made readable for MuJoCo, and those of the package robot_descriptions."""

from __future__ import annotations

import importlib
import logging
import math
import os
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from robot_ik.errors import MissingExtraError, ModelError, UnknownRobotError, did_you_mean

_log = logging.getLogger(__name__)

# What MuJoCo reads (XML reference, asset/mesh).
_MESHES = (".stl", ".obj", ".msh")
# Joints with limits; joints of one number, of which one can mimic another.
_LIMITED = ("revolute", "prismatic")
_FOLLOWED = (*_LIMITED, "continuous")


def _child(parent: ElementTree.Element, tag: str) -> ElementTree.Element:
    found = parent.find(tag)
    return ElementTree.SubElement(parent, tag) if found is None else found


def _limits(joint: ElementTree.Element) -> tuple[float, float] | None:
    """Lower and upper limit of a joint, 0 for one that is not written; None: neither is, or no number."""
    limit = joint.find("limit")
    if limit is None or ("lower" not in limit.attrib and "upper" not in limit.attrib):
        return None
    try:
        return float(limit.get("lower", "0")), float(limit.get("upper", "0"))
    except ValueError:  # MuJoCo says so
        return None


class Urdf:
    """A URDF, by its element ``robot``, and the folder that its file names count from.

    Attributes:
        missing_meshes: Mesh files that ``text`` has left out, as the URDF names them, each once.
    """

    def __init__(self, root: ElementTree.Element, folder: Path) -> None:
        self._root, self._folder = root, folder
        self.missing_meshes: tuple[str, ...] = ()

    @classmethod
    def of_text(cls, text: str, folder: Path = Path()) -> Urdf | None:
        """The URDF in a text whose file names count from ``folder``; None where it is something else."""
        try:
            root = ElementTree.fromstring(text)
        except (ElementTree.ParseError, ValueError):  # MuJoCo says what is wrong with it
            return None
        return cls(root, folder) if root.tag == "robot" else None

    @property
    def problem(self) -> tuple[str, str]:
        """What MuJoCo would not say, or not in words of a URDF, and what to try; empty: nothing."""
        texts = [text for element in self._root.iter() for text in (element.tag, *element.attrib.values())]
        if any("xacro}" in text or "${" in text or "$(" in text for text in texts):
            return (
                "it is a xacro file, from which a URDF is yet to be made",
                "xacro arm.urdf.xacro > arm.urdf",
            )
        joints = self._root.findall("joint")
        names = [joint.get("name", "") for joint in joints]
        doubled = next((name for name in names if names.count(name) > 1), None)
        if doubled is not None:
            return f"two joints are called {doubled!r}", "each needs its own name"
        return self._still_joints() or self._lost_leader() or ("", "")

    def _still_joints(self) -> tuple[str, str] | None:
        """Which joint has two equal limits: of 0 … 0 MuJoCo would make no limit at all."""
        for joint in self._root.findall("joint"):
            limits = _limits(joint)
            if joint.get("type") in _LIMITED and limits and limits[0] == limits[1]:
                return (
                    f"joint {joint.get('name', '')!r} has the limits {limits[0]:g} … {limits[1]:g}, "
                    "so it cannot move",
                    'write where it may move, or type="fixed" to hold it still; '
                    'a revolute joint without limits is of type="continuous"',
                )
        return None

    def _lost_leader(self) -> tuple[str, str] | None:
        """Which joint is to follow one that it cannot follow: MuJoCo would let it move freely."""
        kinds = {joint.get("name", ""): joint.get("type", "") for joint in self._root.findall("joint")}
        able = [name for name, kind in kinds.items() if kind in _FOLLOWED]
        for joint in self._root.findall("joint"):
            mimic, name = joint.find("mimic"), joint.get("name", "")
            if mimic is None or kinds[name] == "fixed":
                continue
            leader = mimic.get("joint", "")
            unable = [one for one in (leader, name) if one not in able]
            if leader == name:
                why = "which is itself"
            elif leader not in kinds:
                why = "which does not exist"
            elif unable:
                why = f"but {unable[0]!r} is {kinds[unable[0]]}"
            else:
                continue
            others = [one for one in able if one != name]
            hint = did_you_mean(leader, others) or f"it may mimic one of: {', '.join(others) or 'none'}"
            return f"joint {name!r} mimics {leader!r}, {why}", hint
        return None

    @property
    def velocity(self) -> dict[str, float]:
        """Joint -> rad/s or m/s, where the file limits it."""
        found = {}
        for joint in self._root.iter("joint"):
            limit = joint.find("limit")
            try:
                velocity = float(limit.get("velocity", "0")) if limit is not None else 0.0
            except ValueError:
                velocity = 0.0  # MuJoCo does not read it, so it is not checked to be a number
            if 0.0 < velocity < math.inf:
                found[joint.get("name", "")] = velocity
        return found

    def text(self) -> str:
        """What MuJoCo shall read.

        Fixed joints keep their frames, and meshes are found, unless the file's own ``<mujoco>`` says more.
        A mesh that is not there, or that MuJoCo does not read (.dae), is left out: kinematics needs none.
        """
        for joint in self._root.findall("joint"):
            limit = joint.find("limit")
            if limit is not None and joint.get("type") in _LIMITED and _limits(joint) is not None:
                limit.attrib.setdefault("lower", "0")  # MuJoCo takes one limit alone for none
                limit.attrib.setdefault("upper", "0")
        compiler = _child(_child(self._root, "mujoco"), "compiler")
        compiler.attrib.setdefault("fusestatic", "false")
        if "meshdir" not in compiler.attrib and "strippath" not in compiler.attrib:
            compiler.set("strippath", "false")
            self._find_meshes()
        return ElementTree.tostring(self._root, encoding="unicode")

    def _find_meshes(self) -> None:
        missing = []
        for link in self._root.iter("link"):
            for shape in [*link.findall("visual"), *link.findall("collision")]:
                mesh = shape.find("geometry/mesh")
                if mesh is None:
                    continue
                asked = mesh.get("filename", "")
                found = self._file(asked)
                if found is None or found.suffix.lower() not in _MESHES:
                    missing.append(asked)
                    link.remove(shape)
                else:
                    mesh.set("filename", str(found))
        self.missing_meshes = tuple(dict.fromkeys(missing))
        if missing:
            _log.warning(
                "meshes left out, since not there or neither STL nor OBJ: %d (%s%s)",
                len(missing), ", ".join(missing[:3]), ", …" if len(missing) > 3 else "",
            )  # fmt: skip

    def _file(self, name: str) -> Path | None:
        """The file that ``package://PACKAGE/…``, ``file://…`` or a plain name means; None: there is none."""
        folder = self._folder.resolve()
        tries = []
        if name.startswith("package://"):
            package, _, rest = name.removeprefix("package://").partition("/")
            for above in (folder, *folder.parents):
                tries += [above / package / rest, *([above / rest] if above.name == package else [])]
        else:
            plain = Path(name.removeprefix("file://"))
            tries = [folder / plain, folder / plain.name]
        return next((path for path in tries if path.is_file()), None)


def described_model(name: str) -> Path:
    """The model file of a description of the package robot_descriptions: its MJCF, else its URDF.

    The package gets it with git, once, unless it lies in its cache.

    Raises:
        MissingExtraError: The package is not installed.
        UnknownRobotError: It has no such description; close ones are named.
        ModelError: git could not get it.
    """
    try:
        from robot_descriptions import DESCRIPTIONS as known
    except ImportError as error:
        raise MissingExtraError("robot_descriptions", "descriptions", f"the robot {name!r}") from error
    if name not in known:
        raise UnknownRobotError(name, known, hint="all names: python -m robot_descriptions list")
    try:
        module = importlib.import_module(f"robot_descriptions.{name}")
    except Exception as error:  # git's own errors are of many classes, and long
        folder = os.environ.get("ROBOT_DESCRIPTIONS_CACHE", "~/.cache/robot_descriptions")
        reason = next((line.strip() for line in reversed(str(error).splitlines()) if line.strip()), "")
        raise ModelError(
            f"the description {name!r} is not in {folder}, and git could not get it: {reason[:200]}",
            reason=str(error),
            hint=f"where there is a network: python -m robot_descriptions pull {name}",
        ) from error
    return Path(getattr(module, "MJCF_PATH", None) or module.URDF_PATH)
