"""The wheel equals the checkout, and an import is fast and opens nothing."""

import json
import os
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SETUPTOOLS = PROJECT["tool"]["setuptools"]
MAPPING: dict[str, str] = SETUPTOOLS["package-dir"]


def packages_on_disk() -> set[str]:
    return {
        ".".join((package, *file.parent.relative_to(ROOT / folder).parts))
        for package, folder in MAPPING.items()
        for file in (ROOT / folder).rglob("__init__.py")
    }


def files_on_disk() -> set[str]:
    """Every file of the mapped folders, under the name it must have in the wheel."""
    return {
        (Path(*package.split(".")) / file.relative_to(ROOT / folder)).as_posix()
        for package, folder in MAPPING.items()
        for file in (ROOT / folder).rglob("[!.]*")
        if file.is_file() and "__pycache__" not in file.parts
    }


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """The wheel, built from the sdist as in `make wheel`, so both are checked."""
    folder = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    result = subprocess.run(build, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    return zipfile.ZipFile(next(folder.glob("*.whl")))


def test_package_list_equals_disk() -> None:
    assert set(SETUPTOOLS["packages"]) == packages_on_disk()


def test_folders_with_python_are_packages() -> None:
    """A folder without __init__.py works in the checkout but is missing from the wheel."""
    folders = {file.parent for folder in MAPPING.values() for file in (ROOT / folder).rglob("*.py")}
    assert [str(f) for f in folders if not (f / "__init__.py").exists()] == []


def test_the_wheel_contains_all_files_and_no_others(wheel: zipfile.ZipFile) -> None:
    packed = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert packed == files_on_disk()


def test_the_wheel_contains_licence_and_type_marker(wheel: zipfile.ZipFile) -> None:
    names = wheel.namelist()
    assert "robot_ik/py.typed" in names
    (metadata,) = (wheel.read(n).decode() for n in names if n.endswith(".dist-info/METADATA"))
    assert "License-Expression: Apache-2.0" in metadata
    (licence,) = (wheel.read(n).decode() for n in names if n.endswith("/licenses/LICENSE"))
    assert "END OF TERMS AND CONDITIONS" in licence


def test_constraints_name_every_dependency_and_no_location() -> None:
    lines = [
        x for x in (ROOT / "constraints.txt").read_text().splitlines() if not x.startswith("#")
    ]
    for line in lines:
        requirement = line.partition(";")[0]
        assert "==" in requirement and not set("/@+ ").intersection(requirement.strip()), line
    pinned = {line.partition("==")[0].lower() for line in lines}
    extras = PROJECT["project"]["optional-dependencies"].values()
    for wanted in [*PROJECT["project"]["dependencies"], *(x for extra in extras for x in extra)]:
        name = wanted.partition(">")[0].lower()
        assert name in pinned, f"{wanted} is not pinned: make constraints"


WATCHED_IMPORT = """
import sys, threading
seen = []

def watch(event, args):
    writes = event == "open" and isinstance(args[1], str) and set("wax+") & set(args[1])
    others = {"os.mkdir", "ctypes.dlopen", "subprocess.Popen"}
    if writes or event in others or event.startswith("socket."):
        seen.append([event, str(args)])

import numpy  # ports and geometry may import it; files that numpy opens do not count
before = set(sys.modules)
sys.addaudithook(watch)
import robot_ik
loaded = sorted({name.partition(".")[0] for name in set(sys.modules) - before})
import json
print(json.dumps({"seen": seen, "loaded": loaded, "threads": threading.active_count()}))
"""


def test_import_opens_nothing_and_loads_nothing_heavy() -> None:
    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}
    child = [sys.executable, "-c", WATCHED_IMPORT]
    result = subprocess.run(child, capture_output=True, text=True, env=environment)
    assert result.returncode == 0, result.stderr
    facts = json.loads(result.stdout)
    assert facts["seen"] == []
    assert facts["threads"] == 1
    heavy = {
        "numba",
        "llvmlite",
        "cv2",
        "mujoco",
        "OpenGL",
        "glfw",
        "serial",
        "dynamixel_sdk",
        "pydantic",
    }
    heavy |= {"rich", "cyclopts", "viser", "av", "matplotlib", "yaml", "scipy"}
    assert heavy.isdisjoint(facts["loaded"])


ONE_SOLVE = """
import sys
import robot_ik as rik

robot = rik.load_robot("puma560")
rik.solve(robot, rik.PoseGoal.at(robot.tool, robot.forward(robot.home)), solver="lm")
print(*(name for name in sys.modules if name.startswith("robot_ik.")))
"""


def test_a_solve_loads_only_the_core() -> None:
    """No goals of the whole body, no other method, no camera, no hardware."""
    command = [sys.executable, "-c", ONE_SOLVE]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    unneeded = ("body_goals", "batch", "solvers.damped_least_squares", "solvers.combined")
    unneeded += (
        "camera",
        "hardware",
        "figure",
        "motion",
        "testbed",
        "script",
        "workcell",
        "commands",
    )
    assert "robot_ik.solvers.levenberg_marquardt" in loaded
    assert sorted(loaded & {f"robot_ik.{name}" for name in unneeded}) == []


def test_hardware_cannot_be_imported_by_its_bare_name() -> None:
    """In the checkout `import hardware` would load every module a second time."""
    bare = subprocess.run(
        [sys.executable, "-c", "import hardware"], cwd=ROOT, capture_output=True, text=True
    )
    assert bare.returncode == 1
    assert "robot_ik.hardware" in bare.stderr


def test_a_type_checker_sees_the_editable_install(
    tmp_path: Path, pytestconfig: pytest.Config
) -> None:
    if not Path(sysconfig.get_path("purelib"), "robot_ik_stubs.pth").is_file():
        pytest.skip("this environment was not made by `make`, which links the stubs")
    script = tmp_path / "mine.py"
    script.write_text(
        "import robot_ik as rik\nfrom robot_ik.hardware.config import ArmConfig\n"
        'number: int = rik.load_robot("puma560")\nreveal_type(ArmConfig.load("arm.toml"))\n'
    )
    cache = pytestconfig.cache.mkdir("mypy")  # numpy's types are read once
    command = [sys.executable, "-m", "mypy", "--cache-dir", str(cache), "mine.py"]
    output = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False
    ).stdout
    assert 'expression has type "Robot"' in output and "config.ArmConfig" in output, output
    assert "import-not-found" not in output
